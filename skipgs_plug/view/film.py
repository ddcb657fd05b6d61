"""Write frames to an mp4, or to a folder of PNG files."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.files import WriteError
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_aside

QUALITY = 8  # on imageio's scale from 0 (smallest file) to 10 (best picture)


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int) -> None:
    """Write frames [H, W, 3] uint8 of one size as H.264; an odd last row or column is cut off.

    Raises:
        WriteError: The film cannot be written completely.
    """
    import imageio.v2 as iio
    from imageio_ffmpeg import count_frames_and_secs  # imageio says too little if this package of its own is missing

    with write_aside(path) as temporary:
        target = temporary.with_suffix(".mp4")  # ffmpeg goes by the suffix
        try:
            target.touch()  # fails with a reason, unlike the encoder
            options: dict[str, Any] = {"fps": fps, "quality": QUALITY, "macro_block_size": 2}
            with iio.get_writer(target, format="FFMPEG", **options) as writer:
                given = append_frames(writer, path, frames)
            with encoder_ended_early(path):
                found = count_frames_and_secs(str(target))[0]
                if found != given:  # imageio ignores the exit code of its encoder
                    raise RuntimeError(f"{target} has {found} of {given} frames")
            target.replace(temporary)
        finally:
            target.unlink(missing_ok=True)


def append_frames(writer: Any, path: Path, frames: Iterable[np.ndarray]) -> int:
    """Encode frames for the film at `path`, and return their number."""
    given = 0
    for frame in frames:
        height, width = (side // 2 * 2 for side in frame.shape[:2])
        with encoder_ended_early(path):
            writer.append_data(frame[:height, :width])
        given += 1
    return given


@contextlib.contextmanager
def encoder_ended_early(path: Path) -> Iterator[None]:
    """Raise WriteError instead of imageio's error, which holds the whole command line of the encoder."""
    try:
        yield
    except (OSError, RuntimeError) as error:
        raise WriteError(
            f"{path} cannot be written (the encoder ended early; see its output); make room or give another path."
        ) from error


def write_pictures(folder: Path, frames: Iterable[np.ndarray], names: Iterable[str]) -> None:
    """Write frames [H, W, 3] uint8 as PNG files of these names into a folder that must be new or empty.

    Raises:
        InputError: The folder is not empty.
    """
    from PIL import Image

    if folder.exists() and (folder.is_file() or any(folder.iterdir())):
        raise InputError(f"{folder} exists and is not an empty folder; give another OUT, or a name that ends in .mp4.")
    for frame, name in zip(frames, names, strict=True):
        with write_aside(folder / f"{name}.png") as temporary:
            Image.fromarray(frame).save(temporary, format="PNG", compress_level=1)
