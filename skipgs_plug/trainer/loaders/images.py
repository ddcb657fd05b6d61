"""Read one photograph or mask: depth, transparency, orientation, size, and errors that name the file."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import IO

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from skipgs_plug.trainer.errors import InputError, MissingFileError, reason
from skipgs_plug.trainer.lfs import HINT, is_pointer

LOSSY = (".jpg", ".jpeg", ".webp")
ORIENTATION = 0x0112  # EXIF tag; 5 to 8 exchange width and height


def read_image(
    source: Path | IO[bytes],
    label: Path | str,
    background: tuple[float, float, float] | None = None,
    factor: int = 1,
    size: tuple[int, int] | None = None,
) -> tuple[Tensor, Tensor | None]:
    """Decode an image and shrink it by `factor` (bicubic).

    Args:
        source: File or stream.
        label: Name of the image in errors.
        background: Colour that transparency is composed onto; None keeps colours, for alpha as a mask.
        factor: Factor by which the image is reduced.
        size: Width and height that the camera was calibrated for. Pixels stay as they are stored, as in COLMAP. The
            orientation in EXIF is applied only if the image fits the camera with it and not without it.

    Returns:
        Image [H, W, 3] uint8, and its alpha [H, W] uint8 or None.

    Raises:
        MissingFileError: The file does not exist.
        InputError: The image is damaged, too large, of a type whose range of values is unknown, or its shape does not
            fit `size`.
    """
    picture = upright(decode(source, label), label, size)
    has_alpha = has_transparency(picture)
    picture = picture.convert("RGBA" if has_alpha else "RGB")
    alpha = None
    if has_alpha:
        alpha = picture.getchannel("A")
        if background is None:
            picture = picture.convert("RGB")
        else:
            rgba = np.asarray(picture, dtype=np.float32) / 255.0
            composed = rgba[..., :3] * rgba[..., 3:] + np.array(background, dtype=np.float32) * (1.0 - rgba[..., 3:])
            picture = Image.fromarray(np.rint(composed * 255.0).astype(np.uint8))
    if factor > 1:
        reduced = (max(1, round(picture.width / factor)), max(1, round(picture.height / factor)))
        picture = picture.resize(reduced, Image.Resampling.BICUBIC)
        alpha = None if alpha is None else alpha.resize(reduced, Image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(picture)), None if alpha is None else torch.from_numpy(np.array(alpha))


def has_transparency(picture: Image.Image) -> bool:
    return picture.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in picture.info


def read_mask(path: Path, image: Tensor, size: tuple[int, int]) -> Tensor:
    """Return a mask [H, W] bool of the size of `image` [H, W, 3]: True where it is neither black nor transparent.

    Lossy formats leave grey at edges, so their threshold is half of white.
    """
    picture = upright(decode(path, path), path, size)
    if has_transparency(picture):
        picture = picture.convert("RGBA")
        picture = Image.alpha_composite(Image.new("RGBA", picture.size, (0, 0, 0, 255)), picture)
    picture = picture.convert("L").resize((image.shape[1], image.shape[0]), Image.Resampling.NEAREST)
    least = 128 if path.suffix.lower() in LOSSY else 1
    return torch.from_numpy(np.array(picture)) >= least


def decode(source: Path | IO[bytes], label: Path | str) -> Image.Image:
    """Return the decoded picture, 16-bit grey as 8-bit grey."""
    if isinstance(source, Path) and not os.path.isfile(source):
        raise MissingFileError(f"Image {source} does not exist; restore it or remove it from the reconstruction.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings about metadata that is not used
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(source) as opened:
                opened.load()
                picture = opened.copy()
                picture.info = opened.info
    except (Image.DecompressionBombWarning, Image.DecompressionBombError, MemoryError) as error:
        limit = f"{Image.MAX_IMAGE_PIXELS:,}" if Image.MAX_IMAGE_PIXELS else "memory's number of"
        raise InputError(f"Image {label} has more than {limit} pixels; shrink it.") from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, EOFError, KeyError, IndexError, TypeError,
            OverflowError, AttributeError, NotImplementedError, RuntimeError, ZeroDivisionError) as error:  # fmt: skip
        # Pillow's plugins raise many kinds of errors on damaged files.
        if isinstance(source, Path) and is_pointer(source):
            raise InputError(f"Image {label} cannot be decoded: {HINT}.") from error
        raise InputError(f"Image {label} cannot be decoded ({reason(error)}); replace the file.") from error
    if picture.mode.startswith("I;16") or (picture.mode == "I" and opened.format == "PNG"):
        values = np.asarray(picture).astype(np.uint16)
        info = picture.info
        picture = Image.fromarray(np.rint(values / 257.0).astype(np.uint8))
        if "transparency" in info:
            picture.putalpha(Image.fromarray(np.where(values == info["transparency"], 0, 255).astype(np.uint8)))
    elif picture.mode.startswith(("I", "F")):
        raise InputError(
            f"Image {label} has {'float' if picture.mode[0] == 'F' else '32-bit'} values, whose range is unknown; "
            "convert it to 8 or 16 bits."
        )
    return picture


def upright(picture: Image.Image, label: Path | str, size: tuple[int, int] | None) -> Image.Image:
    """Return the picture in the orientation in which it has the aspect of `size` (width, height)."""
    if size is None or same_aspect(picture.size, size):
        return picture
    if picture.getexif().get(ORIENTATION) in (5, 6, 7, 8):
        turned = ImageOps.exif_transpose(picture)
        if same_aspect(turned.size, size):
            return turned
    raise InputError(
        f"Image {label} is {picture.width}x{picture.height}, but its camera is "
        f"{size[0]}x{size[1]}; restore the image that the camera was calibrated for"
        + (" (it seems to be rotated)." if same_aspect(picture.size, size[::-1]) else ".")
    )


def same_aspect(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether one size is a scaled copy of the other, up to a rounded or cut pixel per side."""
    (width, height), (full_width, full_height) = size, other
    return abs(height * full_width - width * full_height) <= full_width + full_height
