"""Write frames to an mp4, or to a folder of PNG files."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_aside

QUALITY = 8  # of imageio's scale to 10


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    """Write frames [H, W, 3] uint8 of one size as H.264; an odd last row or column is cut off."""
    import imageio.v2 as iio

    with write_aside(path) as temporary:
        target = temporary.with_suffix(".mp4")  # ffmpeg goes by the suffix
        try:
            options: dict[str, Any] = {"fps": fps, "quality": QUALITY, "macro_block_size": 2}
            writer: Any
            with iio.get_writer(target, format="FFMPEG", **options) as writer:
                for frame in frames:
                    height, width = (side // 2 * 2 for side in frame.shape[:2])
                    writer.append_data(frame[:height, :width])
            target.replace(temporary)
        finally:
            target.unlink(missing_ok=True)


def write_pictures(folder: Path, frames: Iterable[np.ndarray], names: Iterable[str]) -> None:
    """Write frames [H, W, 3] uint8 as PNG files of these names into a folder that must be new or empty.

    Raises:
        InputError: the folder holds something.
    """
    from PIL import Image

    if folder.exists() and (folder.is_file() or any(folder.iterdir())):
        raise InputError(f"{folder} exists and is not an empty folder; give another OUT, or a name that ends in .mp4.")
    for frame, name in zip(frames, names, strict=True):
        with write_aside(folder / f"{name}.png") as temporary:
            Image.fromarray(frame).save(temporary, format="PNG")
