"""Whether packages that trainers import can be imported here."""

from __future__ import annotations

import importlib


def usable(package: str) -> bool:
    """Whether a package can be imported: one that is installed may be of another PyTorch, and broken."""
    try:
        importlib.import_module(package)
    except Exception:  # whatever its first lines run into
        return False
    return True
