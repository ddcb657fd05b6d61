"""What an editor needs to read the kernels: the names that Python declares, and a compile database.

    python -m skipgs_plug.fallback_raster.declarations [FOLDER]

Kernels use constants and structs whose only declaration is in Python (`runtime/constants.py`, `runtime/parameters.py`).
This writes `declarations.h` with all of them, and `compile_commands.json` that includes it in front of each file, into
FOLDER, `build` by default. clangd finds `build/compile_commands.json` from the files below the folder that `build` lies
in; other editors are told where it is.
"""

import importlib
import json
import pkgutil
import sys
from pathlib import Path
from typing import Any

from . import stages, training
from .runtime.launch import Worker
from .runtime.parameters import declare_struct
from .runtime.source import KERNELS, SHARED, declare

# Warp gives its Clang the same standard. Kernels are headers of their own, of which each is included once.
FLAGS = ("-std=c++17", "-xc++", "-Wno-pragma-once-outside-header")


def workers() -> dict[str, Worker[Any]]:
    """All kernels of the package by name."""
    names = [
        f"{package.__name__}.{module.name}"
        for package in (stages, training)
        for module in pkgutil.iter_modules(package.__path__)
    ]
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    found = [one for value in values for one in (value.values() if isinstance(value, dict) else [value])]
    return {one.name: one for one in found if isinstance(one, Worker)}


def declarations() -> str:
    """C++ that declares all constants and structs; of a constant that differs between kernels, one of its values."""
    constants = dict(SHARED)
    structs: dict[str, type] = {}
    for worker in workers().values():
        constants = worker.constants | constants
        structs |= {struct.__name__: struct for struct in worker.structs}
    text = "// Written by `python -m skipgs_plug.fallback_raster.declarations`.\n#pragma once\n"
    return text + declare(constants) + "".join(map(declare_struct, structs.values()))


def compile_commands(header: Path) -> list[dict[str, Any]]:
    """Entries of a compile database, one for each file, that include `header` first."""
    return [
        {
            "directory": str(KERNELS),
            "file": str(path),
            "arguments": ["clang++", *FLAGS, "-include", str(header), "-fsyntax-only", str(path)],
        }
        for path in sorted(KERNELS.rglob("*.h"))
    ]


def write(folder: Path) -> Path:
    """Write both files into a folder, and return the compile database."""
    folder.mkdir(parents=True, exist_ok=True)
    header, database = folder / "declarations.h", folder / "compile_commands.json"
    header.write_text(declarations(), encoding="utf-8")
    database.write_text(json.dumps(compile_commands(header.resolve()), indent=1) + "\n", encoding="utf-8")
    return database


if __name__ == "__main__":
    print(write(Path(*sys.argv[1:] or ["build"])))
