"""Checks whether packages that trainers import can be imported here."""

from __future__ import annotations

import importlib


def usable(package: str) -> bool:
    """Return whether a package can be imported. An installed package may be broken, built for another PyTorch."""
    try:
        importlib.import_module(package)
    except Exception:  # a broken package may raise anything
        return False
    return True
