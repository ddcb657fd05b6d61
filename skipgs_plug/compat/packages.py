"""Checks whether packages that trainers import can be imported here, and answers such checks of others."""

from __future__ import annotations

import functools
import importlib
import importlib.util
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from importlib.machinery import ModuleSpec


def usable(package: str) -> bool:
    """Return whether a package can be imported. An installed package may be broken, built for another PyTorch."""
    try:
        importlib.import_module(package)
    except Exception:  # a broken package may raise anything
        return False
    return True


@contextmanager
def reported_missing(packages: Collection[str]) -> Iterator[None]:
    """Let `importlib.util.find_spec` return None for packages that are served in part, inside the `with` statement.

    A library asks it whether a package is installed, and would use more of it than is served. torchmetrics imports
    models of torchvision if it finds torchvision.

    Args:
        packages: Names of top-level packages.
    """
    original, hidden = importlib.util.find_spec, set(packages)

    @functools.wraps(original)
    def find_spec(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name.partition(".")[0] in hidden else original(name, package)

    importlib.util.find_spec = find_spec
    try:
        yield
    finally:
        importlib.util.find_spec = original
        hidden.clear()  # a library may keep this function
