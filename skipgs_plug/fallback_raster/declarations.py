"""Writes files with which an editor can resolve every name in the kernels: C++ declarations and a compile database.

    python -m skipgs_plug.fallback_raster.declarations [FOLDER]

Kernels use constants and structs that only Python declares (`runtime/constants.py`, `runtime/parameters.py`). The
command writes `declarations.h` with all of them, and `compile_commands.json`, which includes it before each file.
FOLDER is `build` by default. clangd finds `build/compile_commands.json` for all files below the parent folder of
`build`; other editors have to be told its path.
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

# Warp compiles with the same standard. Kernels are headers that are compiled as main files.
FLAGS = ("-std=c++17", "-xc++", "-Wno-pragma-once-outside-header")


def workers() -> dict[str, Worker[Any]]:
    """Return all kernels of the package by name."""
    names = [
        f"{package.__name__}.{module.name}"
        for package in (stages, training)
        for module in pkgutil.iter_modules(package.__path__)
    ]
    values = [value for name in names for value in vars(importlib.import_module(name)).values()]
    found = [one for value in values for one in (value.values() if isinstance(value, dict) else [value])]
    return {one.name: one for one in found if isinstance(one, Worker)}


def declarations() -> str:
    """Return C++ that declares all constants and structs. One value stands for constants that differ by kernel."""
    constants = dict(SHARED)
    structs: dict[str, type] = {}
    for worker in workers().values():
        constants = worker.constants | constants
        structs |= {struct.__name__: struct for struct in worker.structs}
    text = "// Written by `python -m skipgs_plug.fallback_raster.declarations`.\n#pragma once\n"
    return text + declare(constants) + "".join(map(declare_struct, structs.values()))


def compile_commands(header: Path) -> list[dict[str, Any]]:
    """Return entries of a compile database, one per file, that include `header` first."""
    return [
        {
            "directory": str(KERNELS),
            "file": str(path),
            "arguments": ["clang++", *FLAGS, "-include", str(header), "-fsyntax-only", str(path)],
        }
        for path in sorted(KERNELS.rglob("*.h"))
    ]


def write(folder: Path) -> Path:
    """Write both files to a folder and return the path of the compile database."""
    folder.mkdir(parents=True, exist_ok=True)
    header, database = folder / "declarations.h", folder / "compile_commands.json"
    header.write_text(declarations(), encoding="utf-8")
    database.write_text(json.dumps(compile_commands(header.resolve()), indent=1) + "\n", encoding="utf-8")
    return database


if __name__ == "__main__":
    print(write(Path(*sys.argv[1:] or ["build"])))
