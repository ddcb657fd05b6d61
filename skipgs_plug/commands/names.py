"""Checks of the folder names that a user gives."""

from __future__ import annotations

import os
from pathlib import Path

from skipgs_plug.trainer.errors import InputError


def require_folder(out: str) -> None:
    """Raise InputError if a folder cannot be made, before hours of work for it."""
    folder = Path(out).expanduser().absolute()
    nearest = next(place for place in (folder, *folder.parents) if os.path.lexists(place))
    if not nearest.exists():
        raise InputError(f"--out {out}: {nearest} is a link to nothing; remove it or give another --out.")
    if not nearest.is_dir():
        raise InputError(f"--out {out}: {nearest} is a file; give the name of a folder.")
    if not os.access(nearest, os.W_OK):
        raise InputError(f"--out {out}: {nearest} cannot be written; change its permissions or give another --out.")
