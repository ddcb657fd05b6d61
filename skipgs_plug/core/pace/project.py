"""The user's own project: the source files around the training loop, without installed packages and the gate."""

from __future__ import annotations

import functools
import sysconfig
from collections.abc import Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

_LIBRARIES = [Path(__file__).resolve().parents[2], Path(sysconfig.get_path("stdlib")).resolve()]
_INSTALLED = frozenset({"site-packages", "dist-packages"})  # names of folders that hold installed packages


class Project:
    """Tells functions of the project from those of libraries.

    The project is the folder from which the loop's module is imported, or the folder of a script, with all folders
    inside it. A loop of an installed package has no project.

    Args:
        code: Code of the function that holds the loop, or of its module.
        names: Global names of its module.
    """

    def __init__(self, code: CodeType, names: Mapping[str, Any]) -> None:
        # A module that runs as a script (`python -m package.train`) has its name in its specification only.
        module = getattr(names.get("__spec__"), "name", None) or str(names.get("__name__", ""))
        above = Path(code.co_filename).resolve().parents
        self._folder = above[min(module.count("."), len(above) - 1)]

    def __contains__(self, function: FunctionType) -> bool:
        return _is_below(function.__code__.co_filename, self._folder)


@functools.cache
def _is_below(file: str, folder: Path) -> bool:
    path = Path(file).resolve()
    library = not _INSTALLED.isdisjoint(path.parts) or any(one in path.parents for one in _LIBRARIES)
    return folder in path.parents and not library
