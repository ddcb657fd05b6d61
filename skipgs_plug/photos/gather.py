"""Prepare photographs for reconstruction: upright, in formats that COLMAP reads, in one folder."""

from __future__ import annotations

import functools
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageOps

from skipgs_plug.photos.video import VIDEO_SUFFIXES, sharpest_frames
from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.loaders import is_scene
from skipgs_plug.trainer.loaders.images import ORIENTATION, decode

# Suffixes of files that are linked, converted to JPEG, and refused.
AS_THEY_ARE = (".jpg", ".jpeg", ".png")
CONVERTED = (".webp", ".bmp", ".tif", ".tiff")
UNREADABLE = (".heic", ".heif", ".dng", ".cr2", ".nef", ".arw")
MODEL, FOCAL_LENGTH, EXIF_BLOCK = 0x0110, 0x920A, 0x8769  # EXIF tags
QUALITY: dict[str, Any] = {"quality": 97, "subsampling": 0}  # options of Pillow for JPEG files
OPAQUE = 128  # least alpha, of 255, of a pixel that is not masked; the same as in the loaders
REDUCED = re.compile(r"(.+)_(\d+)(?:_png)?")  # name of a folder of reduced photographs, as Mip-NeRF 360 and gsplat have
LEAST = 3  # least number of photographs; fewer cannot be reconstructed


@dataclass
class Gathered:
    """Photographs in a folder of their own.

    Attributes:
        folder: The folder.
        names: Paths of the photographs relative to the folder, sorted.
        one_camera: Whether all photographs have the same size, camera model and focal length, and so share intrinsics.
        masks: Folder with a mask for each photograph that has transparent pixels, `photo.png.png` for `photo.png`,
            black where alpha is below one half; None if no pixel is transparent.
    """

    folder: Path
    names: list[str]
    one_camera: bool
    masks: Path | None = None


def are_photographs(source: Path) -> bool:
    """Return whether `source` is a video, or a folder that contains photographs but no cameras."""
    if source.is_file():
        return source.suffix.lower() in VIDEO_SUFFIXES
    if not source.is_dir() or is_scene(source):
        return False
    return any(True for _ in photographs(source))  # the first one is enough


def photographs(folder: Path) -> Iterator[Path]:
    """Yield the photographs in a folder and its subfolders, also those in formats that cannot be read.

    Reduced copies are left out; see `is_of_copies`.
    """
    known = AS_THEY_ARE + CONVERTED + UNREADABLE
    of_copies = functools.cache(is_of_copies)
    for path in walk(folder):
        if path.suffix.lower() not in known or path.name.startswith(".") or path.is_dir():
            continue
        if path.parent == folder or not of_copies(path.parent):
            yield path


def is_of_copies(folder: Path) -> bool:
    """Return whether a folder such as `images_4` holds reduced copies of the photographs in `images` beside it.

    With them each photograph would count twice, and held-out views would be trained on. Cameras that count from 1 give
    other photographs the same names, so the widths must fit the number in the folder's name.
    """
    match = REDUCED.fullmatch(folder.name)
    whole = None if match is None else folder.with_name(match[1])
    if match is None or whole is None or not whole.is_dir():
        return False
    copies, originals = ({path.stem: path for path in one.iterdir()} for one in (folder, whole))
    if not copies or not copies.keys() <= originals.keys():
        return False
    factor, name = int(match[2]), min(copies)
    try:
        with Image.open(copies[name]) as copy, Image.open(originals[name]) as original:
            return factor > 1 and abs(copy.width - original.width / factor) <= 1.0
    except OSError:  # no picture
        return False


def walk(folder: Path) -> Iterator[Path]:
    """Yield the files in a folder and its subfolders. Follow links, but visit each real folder only once."""
    seen: set[str] = set()
    for root, folders, files in os.walk(folder, followlinks=True):
        # Programs create folders with names that start with a dot: .ipynb_checkpoints, .thumbnails, .Trash.
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        real = os.path.realpath(root)
        if real in seen:  # a link to a parent folder, or a second link to the same folder
            folders.clear()
            continue
        seen.add(real)
        yield from (Path(root, name) for name in files)


def check_source(source: Path) -> None:
    """Raise an error if `source` is neither a folder nor a video.

    Raises:
        MissingFileError: `source` does not exist.
        InputError: `source` is a file of another kind.
    """
    if not source.exists():
        raise MissingFileError(f"{source} does not exist; give a folder of photographs or a video.")
    if source.is_file() and source.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(f"{source} is neither a folder nor a video ({' '.join(VIDEO_SUFFIXES)}).")


def gather(source: Path, folder: Path, frames: int, progress: Callable[[int], None]) -> Gathered:
    """Put the photographs of `source` into `folder`.

    Files that need no change are linked. Photographs with an EXIF orientation are turned upright.

    Args:
        source: A folder of photographs, or a video.
        folder: Folder to create.
        frames: Number of frames to take from a video, each the sharpest of its group.
        progress: Called with 1 for each photograph.

    Raises:
        MissingFileError: `source` does not exist, or the target of a link among the photographs does not.
        InputError: A photograph or the video cannot be decoded, or there are fewer than three photographs.
    """
    check_source(source)
    if source.is_file():
        gathered = gather_video(source, folder, frames, progress)
    else:
        gathered = gather_folder(source, folder, progress)
    if len(gathered.names) < LEAST:
        count = len(gathered.names)
        what = "only 1 photograph" if count == 1 else f"only {count} photographs" if count else "no photograph"
        raise InputError(f"{source} gives {what}; take at least 20 that overlap.")
    return gathered


def gather_video(source: Path, folder: Path, frames: int, progress: Callable[[int], None]) -> Gathered:
    names = []
    folder.mkdir(parents=True)
    for number, frame in sharpest_frames(source, frames):
        names.append(f"frame_{number:06d}.jpg")
        Image.fromarray(frame).save(folder / names[-1], **QUALITY)
        progress(1)
    return Gathered(folder, names, one_camera=True)


def gather_folder(source: Path, folder: Path, progress: Callable[[int], None]) -> Gathered:
    files = sorted(photographs(source))
    unreadable = [path for path in files if path.suffix.lower() in UNREADABLE]
    if unreadable:
        others = f" ({len(unreadable) - 1} more of this kind)" if len(unreadable) > 1 else ""
        raise InputError(f"{unreadable[0]} has a format that this package cannot read{others}; export as JPEG.")
    for path in files:
        if not path.exists():
            raise MissingFileError(f"{path} links to a file that does not exist; restore the file or remove the link.")
    names, cameras = [], set()
    masks = folder.with_name("masks")
    for path in files:
        name, camera = add_photograph(path, source, folder, masks)
        names.append(name)
        cameras.add(camera)
        progress(1)
    doubled = {name for name in names if names.count(name) > 1}
    if doubled:
        raise InputError(f"{source} holds two photographs that would both be named {min(doubled)}; rename one.")
    return Gathered(folder, sorted(names), len(cameras) == 1, masks if masks.is_dir() else None)


def add_photograph(path: Path, source: Path, folder: Path, masks: Path) -> tuple[str, tuple[object, ...]]:
    """Link or convert one photograph, and write a mask to `masks` if it has transparent pixels.

    Returns:
        The path of the photograph relative to `folder`, and the values that identify its camera.
    """
    picture = decode(path, path)  # a damaged file raises here, with its name, and not in C++ code later
    exif = picture.getexif()
    target = folder / path.relative_to(source)
    target.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix.lower() in CONVERTED:
        target = target.with_name(f"{path.name}.jpg")
    if exif.get(ORIENTATION, 1) != 1 or path.suffix.lower() in CONVERTED:
        picture = ImageOps.exif_transpose(picture)
        options: dict[str, Any] = {} if target.suffix.lower() == ".png" else QUALITY
        picture.convert("RGB").save(target, exif=picture.getexif(), **options)
    else:
        link(path, target)
    if picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info:
        alpha = picture.convert("RGBA").getchannel("A")
        if np.asarray(alpha).min() < OPAQUE:
            mask = masks / target.relative_to(folder).with_name(f"{target.name}.png")
            mask.parent.mkdir(parents=True, exist_ok=True)
            alpha.point(lambda value: 255 if value >= OPAQUE else 0).save(mask)
    camera = (picture.size, exif.get(MODEL), exif.get_ifd(EXIF_BLOCK).get(FOCAL_LENGTH))
    return target.relative_to(folder).as_posix(), camera


def link(path: Path, target: Path) -> None:
    """Link a file, or copy it if the file system cannot link it."""
    try:
        os.link(path, target)
    except OSError:
        shutil.copyfile(path, target)
