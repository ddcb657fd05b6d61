"""Read one photograph: background under transparency, size, and errors that name the file."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from skipgs_plug.trainer.errors import InputError, MissingFileError

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".JPG", ".JPEG", ".PNG")


def read_image(
    source: Path | IO[bytes],
    label: Path | str,
    background: tuple[float, float, float],
    factor: int = 1,
) -> tuple[Tensor, bool]:
    """Decode an image, compose transparency onto `background`, shrink by `factor` (bicubic).

    Returns:
        image [H, W, 3] uint8, and whether it had an alpha channel.
    """
    if isinstance(source, Path) and not source.is_file():
        raise MissingFileError(f"Image {source} does not exist; restore it or remove it from the reconstruction.")
    try:
        with Image.open(source) as opened:
            opened.load()
            has_alpha = opened.mode in ("RGBA", "LA", "PA") or "transparency" in opened.info
            picture = opened.convert("RGBA" if has_alpha else "RGB")
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise InputError(f"Image {label} cannot be decoded ({error}); replace the file.") from error
    if has_alpha:
        rgba = np.asarray(picture, dtype=np.float32) / 255.0
        composed = rgba[..., :3] * rgba[..., 3:] + np.array(background, dtype=np.float32) * (1.0 - rgba[..., 3:])
        picture = Image.fromarray(np.rint(composed * 255.0).astype(np.uint8))
    if factor > 1:
        size = (max(1, round(picture.width / factor)), max(1, round(picture.height / factor)))
        picture = picture.resize(size, Image.Resampling.BICUBIC)
    return torch.from_numpy(np.array(picture)), has_alpha


def find_image(folder: Path, name: str) -> Path:
    """Return folder/name, or the same stem with another image suffix (downscaled copies are often PNG)."""
    path = folder / name
    if path.is_file():
        return path
    for suffix in IMAGE_SUFFIXES:
        candidate = path.with_suffix(suffix)
        if candidate.is_file():
            return candidate
    raise MissingFileError(f"Image {path} does not exist; restore it or remove it from the reconstruction.")
