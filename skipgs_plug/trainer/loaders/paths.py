"""File names in a scene, which may only lead to files inside its folder."""

from __future__ import annotations

import functools
import os
import time
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from skipgs_plug.files import printable
from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.scene import is_text

# Nanoseconds after a change until a folder's listing is cached. The clocks of file systems have steps of up to 2 s.
SETTLED = 2_000_000_000
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG", ".webp", ".tif", ".tiff", ".bmp")


def relative_name(folder: Path, name: str) -> str:
    """Return a file name in a scene as a path relative to its folder, with slashes.

    Backslashes separate folders, like on Windows, unless a file has them in its name. If a path leaves the folder (it
    was written on another machine, or relative to another folder), its longest end that is an image in the folder
    counts.

    Raises:
        InputError: The name is empty, leaves the folder or cannot be a file name.
    """
    if not is_text(name):
        raise InputError(
            f"{folder}: file name {name[:80]!r} holds control characters or is not UTF-8; rename the file."
        )
    given = name
    if "\\" in name and not os.path.isfile(folder / name):
        name = name.replace("\\", "/")
    path = PurePosixPath(name)
    if path.is_absolute():
        for root in (os.path.abspath(folder), os.path.realpath(folder)):
            if path.is_relative_to(root):
                path = path.relative_to(root)
                break
    if not path.name:
        raise InputError(f"{folder}: file name {given!r} names no file; restore it.")
    if leaves(path):
        ends = (PurePosixPath(*path.parts[i:]) for i in range(1, len(path.parts)))
        inner = next((end for end in ends if not leaves(end) and look_up(folder, end) is not None), None)
        if inner is None:
            raise InputError(
                f"{folder}: file name {given!r} leaves the scene, and no file in the scene has the end of its path; "
                "only files inside the scene are read."
            )
        path = inner
    return path.as_posix()


def leaves(path: PurePosixPath) -> bool:
    """Whether a path leads out of the folder that it is relative to, or may do so on Windows."""
    return path.is_absolute() or ".." in path.parts or bool(PureWindowsPath(path.as_posix()).drive)


def inside(folder: Path, name: str) -> Path:
    """Return folder/name; see `relative_name`.

    Raises:
        InputError: The name is not one of a file inside the folder.
    """
    return folder / relative_name(folder, name)


def find_image(folder: Path, name: str) -> Path:
    """Return the file of an image; see `find_images`."""
    return find_images(folder, [name])[0]


def find_images(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the files of images by their names in a scene.

    Downscaled copies are often PNG, so a file with another or an added image suffix is found too. So is a file whose
    name differs in capital letters, which Windows does not distinguish, and a file under fewer folders than the name
    says, because instant-ngp writes paths relative to the folder from which it was called.

    Raises:
        MissingFileError: Some files do not exist. The message gives their number.
    """
    found = [look_up(folder, PurePosixPath(relative_name(folder, name))) for name in names]
    missing = [name for name, path in zip(names, found, strict=True) if path is None]
    if missing:
        path = inside(folder, missing[0])
        path = path if path.suffix else path.with_suffix(".png")
        others = len(missing) - 1
        more = f", and neither do {others} others of {len(names)}" if others else ""
        pronoun = "them" if others else "it"
        raise MissingFileError(
            f"Image {path} does not exist{found_instead(path)}{more}; restore {pronoun} or remove {pronoun} from the "
            "reconstruction."
        )
    return [path for path in found if path is not None]


def look_up(folder: Path, name: PurePosixPath) -> Path | None:
    """Return the image in a folder with this name, or with nearly this name; None if it does not exist."""
    # Down to one folder and the name: a name alone could belong to another camera.
    ends = [PurePosixPath(*name.parts[start:]) for start in range(max(len(name.parts) - 1, 1))]
    if len(name.parts) == 2 and name.parts[0] == folder.name:  # relative to the folder above
        ends.append(PurePosixPath(name.name))
    for end in ends:
        for candidate in spellings(end):
            if os.path.isfile(folder / candidate):  # unlike Path.is_file, no error for names that are too long
                return folder / candidate
        path = in_any_case(folder, end)
        if path is not None:
            return path
    return None


def spellings(name: PurePosixPath) -> Iterator[PurePosixPath]:
    """Yield a name, the name with other image suffixes, and the name with a suffix added."""
    yield name
    if name.suffix.lower() in IMAGE_SUFFIXES:  # otherwise the text after the dot may belong to the name
        yield from (name.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)
    yield from (name.with_name(name.name + suffix) for suffix in IMAGE_SUFFIXES)


def in_any_case(folder: Path, name: PurePosixPath) -> Path | None:
    """Return the only file whose path differs from `name` by capital letters alone, image suffixes apart."""
    folders = [folder]
    for part in name.parts[:-1]:
        folders = [path for parent in folders for path in entries(parent, [part]) if path.is_dir()]
    wanted = [spelling.name for spelling in spellings(PurePosixPath(name.name))]
    found = [path for parent in folders for path in entries(parent, wanted) if path.is_file()]
    return found[0] if len(found) == 1 else None


def subfolder(folder: Path, name: str) -> Path:
    """Return folder/name, or the only folder there whose name differs from it by capital letters alone."""
    if os.path.isdir(folder / name):
        return folder / name
    found = [path for path in entries(folder, [name]) if path.is_dir()]
    return found[0] if len(found) == 1 else folder / name


def found_instead(path: Path) -> str:
    """Return a clause that names the object found in place of a missing image; empty if there is none."""
    if os.path.isdir(path):
        return " (a folder has its name)"
    if os.path.islink(path):
        return f" (a link to {printable(os.readlink(path))} has its name)"
    near = same_stem(path)
    return f" ({near.name} is there, which is not read: convert it to PNG)" if near else ""


def same_stem(path: Path) -> Path | None:
    """Return a file beside `path` that differs from it by its suffix alone."""
    try:
        others = sorted(path.parent.iterdir())
    except OSError:
        return None
    return next((other for other in others if other.stem == path.stem and other.is_file()), None)


def entries(folder: Path, names: Sequence[str]) -> list[Path]:
    """Return the entries of a folder with one of these names, in any case."""
    try:
        changed = os.stat(folder).st_mtime_ns
        # Files may be added within the same tick of the file system's clock, after the listing.
        list_of = listing if time.time_ns() - changed > SETTLED else listing.__wrapped__
        known = list_of(str(folder), changed)
    except OSError:
        return []
    return [folder / name for wanted in {name.casefold() for name in names} for name in known.get(wanted, ())]


@functools.lru_cache(maxsize=64)
def listing(folder: str, changed: int) -> dict[str, list[str]]:
    """Return the names in a folder by their lower-case form. `changed` (ns) is its time of change, for the cache."""
    result: dict[str, list[str]] = {}
    for name in os.listdir(folder):
        result.setdefault(name.casefold(), []).append(name)
    return result


def unlisted_images(folder: Path, listed: Sequence[Path]) -> list[str]:
    """Return the images below a folder that are not `listed` and not hidden, as sorted relative paths."""
    known = {os.path.normpath(path) for path in listed}
    suffixes = {suffix.lower() for suffix in IMAGE_SUFFIXES}
    result = []
    for root, folders, files in os.walk(folder):
        folders[:] = [name for name in folders if not name.startswith(".")]
        for name in files:
            path = os.path.join(root, name)
            image = os.path.splitext(name)[1].lower() in suffixes and not name.startswith(".")
            if image and os.path.normpath(path) not in known:
                result.append(os.path.relpath(path, folder))
    return sorted(result)
