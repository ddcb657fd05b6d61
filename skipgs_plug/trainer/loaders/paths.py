"""Names that a scene gives: files inside its folder, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath, PureWindowsPath

from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.scene import is_text

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


def inside(folder: Path, name: str) -> Path:
    """Return folder/name.

    Raises:
        InputError: the name is empty, absolute, climbs out of the folder or cannot be a file name.
    """
    parts = [*PurePosixPath(name).parts, *PureWindowsPath(name).parts]
    if not PurePosixPath(name).name or PureWindowsPath(name).anchor or name.startswith("/") or ".." in parts:
        raise InputError(f"{folder}: file name {name!r} leaves the scene; only paths inside it are read.")
    if not is_text(name):
        raise InputError(f"{folder}: file name {name[:80]!r} holds control characters or no UTF-8; rename the file.")
    return folder / name


def find_image(folder: Path, name: str) -> Path:
    """Return folder/name, or the same stem with another image suffix (downscaled copies are often PNG)."""
    path = inside(folder, name)
    for candidate in (path, *(path.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)):
        if os.path.isfile(candidate):  # unlike Path.is_file, no error for names that are too long
            return candidate
    raise MissingFileError(f"Image {path} does not exist; restore it or remove it from the reconstruction.")
