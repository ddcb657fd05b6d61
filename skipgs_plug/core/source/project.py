"""The user's own project: the source files around the training loop, without installed packages and the gate."""

from __future__ import annotations

import functools
import inspect
import sys
import sysconfig
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

STANDARD = frozenset(Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib"))
INSTALLED = frozenset({"site-packages", "dist-packages"})  # names of folders that hold installed packages
FROZEN = "<frozen "  # beginning of the file name in code of the standard library that Python itself holds, as os.path
_LIBRARIES = STANDARD | {Path(__file__).resolve().parents[2]}


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
        path = Path(code.co_filename).resolve()
        self._folder = import_folder(path, module) or path.parent

    def methods(self, name: str) -> Iterator[FunctionType]:
        """Iterate over the methods of this name of all classes in the project's modules that have been imported."""
        for module in [*sys.modules.values()]:
            file = getattr(module, "__file__", None)
            if isinstance(file, str) and _is_below(file, self._folder):
                classes = (value for value in [*vars(module).values()] if inspect.isclass(value))
                found = (vars(cls).get(name) for cls in classes)
                yield from (one for one in found if isinstance(one, FunctionType))

    def __contains__(self, function: FunctionType) -> bool:
        return _is_below(function.__code__.co_filename, self._folder)


def import_folder(file: Path, module: str) -> Path | None:
    """Return the folder that holds the top-level package of a module; None if the file is not that deep.

    Args:
        file: File of the module, without links.
        module: Its full name.
    """
    depth = module.count(".") + (file.name == "__init__.py")
    return file.parents[depth] if depth < len(file.parents) else None


@functools.cache
def _is_below(file: str, folder: Path) -> bool:
    if file.startswith(FROZEN):  # as a path, it would lie in the working folder
        return False
    path = Path(file).resolve()
    library = not INSTALLED.isdisjoint(path.parts) or not _LIBRARIES.isdisjoint(path.parents)
    return folder in path.parents and not library
