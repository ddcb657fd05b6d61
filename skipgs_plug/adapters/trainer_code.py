"""The code of a trainer, told from the code of libraries."""

from __future__ import annotations

import sys
from pathlib import Path
from types import FunctionType, ModuleType

from skipgs_plug.core.source.project import INSTALLED, STANDARD, import_folder

# Packages from which trainers derive classes, and that do not belong to them.
BASES = frozenset({"builtins", "torch"})

Part = FunctionType | type | ModuleType


class TrainerCode:
    """The packages of a trainer, and the folders from which its modules are imported.

    A script imports a helper of its checkout as `utils.prune`, whose top-level package is not the script's. Both are
    imported from one folder. The folder of installed packages holds other packages too, so it does not count.
    """

    def __init__(self) -> None:
        self._packages: set[str] = set()
        self._folders: set[Path] = set()

    def add(self, part: Part) -> None:
        """Add the package and the folder of a function, class or module, and of the classes that a class derives from.

        Python's and PyTorch's own classes are not added.
        """
        for one in part.__mro__ if isinstance(part, type) else (part,):
            folder = folder_of(one)
            if package(one) in BASES or folder in STANDARD:
                continue
            self._packages.add(package(one))
            if folder is not None and folder.name not in INSTALLED:
                self._folders.add(folder)

    def __contains__(self, part: Part) -> bool:
        return package(part) in self._packages or folder_of(part) in self._folders


def package(part: Part) -> str:
    """Return the name of the top-level package of a function, class or module."""
    return _module(part).partition(".")[0]


def folder_of(part: Part) -> Path | None:
    """Return the folder that holds the top-level package of a function, class or module; None without a file."""
    file: str | None
    if isinstance(part, FunctionType):
        file = part.__code__.co_filename
    else:
        file = getattr(part if isinstance(part, ModuleType) else sys.modules.get(part.__module__), "__file__", None)
    if not file or not Path(file).is_file():
        return None
    return import_folder(Path(file).resolve(), _module(part))


def _module(part: Part) -> str:
    return part.__name__ if isinstance(part, ModuleType) else str(part.__module__)
