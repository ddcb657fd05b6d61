"""Names that a scene gives: files inside its folder, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath, PureWindowsPath

from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.scene import is_text

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp")


def relative_name(folder: Path, name: str) -> str:
    """Return a name that a scene gives as a path relative to its folder, with slashes.

    Backslashes separate folders, as programs on Windows write them, unless a file has them in its name. An absolute
    path is taken where it lies in the folder.

    Raises:
        InputError: the name is empty, leaves the folder or cannot be a file name.
    """
    if not is_text(name):
        raise InputError(f"{folder}: file name {name[:80]!r} holds control characters or no UTF-8; rename the file.")
    given = name
    if "\\" in name and not os.path.isfile(folder / name):
        name = name.replace("\\", "/")
    if os.path.isabs(name):
        for root in (os.path.abspath(folder), os.path.realpath(folder)):
            if PurePosixPath(name).is_relative_to(PurePosixPath(root)):
                name = PurePosixPath(name).relative_to(PurePosixPath(root)).as_posix()
                break
    parts = PurePosixPath(name).parts
    if not PurePosixPath(name).name or name.startswith("/") or PureWindowsPath(name).drive or ".." in parts:
        raise InputError(f"{folder}: file name {given!r} leaves the scene; only paths inside it are read.")
    return PurePosixPath(name).as_posix()


def inside(folder: Path, name: str) -> Path:
    """Return folder/name; see `relative_name`.

    Raises:
        InputError: as there.
    """
    return folder / relative_name(folder, name)


def find_image(folder: Path, name: str) -> Path:
    """Return folder/name, or the same with another image suffix or one added (downscaled copies are often PNG)."""
    path = inside(folder, name)
    others = (path.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)
    added = (path.with_name(path.name + suffix) for suffix in IMAGE_SUFFIXES)
    for candidate in (path, *others, *added):
        if os.path.isfile(candidate):  # unlike Path.is_file, no error for names that are too long
            return candidate
    raise MissingFileError(f"Image {path} does not exist; restore it or remove it from the reconstruction.")
