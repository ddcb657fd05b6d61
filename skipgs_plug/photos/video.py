"""Read the sharpest frames of a video, one from each of several groups of equal length."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from skipgs_plug.trainer.errors import InputError, reason

log = logging.getLogger(__name__)

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".3gp")
# Longer side in pixels to which frames are reduced before their sharpness is compared, to average out sensor noise.
JUDGED_SIZE = 640


def count_frames(path: Path) -> int:
    """Return the number of frames in a video.

    Raises:
        InputError: The video cannot be decoded.
    """
    import imageio_ffmpeg

    try:
        frames, _ = imageio_ffmpeg.count_frames_and_secs(str(path))
    except (RuntimeError, OSError) as error:
        raise InputError(f"Video {path} cannot be decoded; export it again as mp4 (H.264).") from error
    return int(frames)


def sharpest_frames(path: Path, wanted: int) -> Iterator[tuple[int, np.ndarray]]:
    """Yield (frame number, frame [H, W, 3] uint8) of the sharpest frame in each of `wanted` groups, in order.

    A video with fewer frames yields all of them. The decoder turns frames upright.

    Raises:
        InputError: The video cannot be decoded.
    """
    import imageio.v3 as iio

    total = count_frames(path)
    if total == 0:
        raise InputError(f"Video {path} contains no frames; record it again.")
    borders = np.linspace(0, total, min(wanted, total) + 1).round().astype(int)[1:]
    group, best, number = 0, (-1.0, 0, np.empty(0)), -1
    try:
        for number, frame in enumerate(iio.imiter(path, plugin="FFMPEG")):
            while group < len(borders) - 1 and number >= borders[group]:
                yield best[1], best[2]
                group, best = group + 1, (-1.0, 0, frame)
            score = sharpness(frame)
            if score > best[0]:
                best = (score, number, frame)
    except (RuntimeError, OSError) as error:
        why = f"cannot be decoded to its end ({reason(error)})"
        raise InputError(f"Video {path} {why}; export it again as mp4 (H.264).") from error
    if number + 1 < total:
        log.warning("%s: only %d of %d frames can be decoded; record or export it again.", path, number + 1, total)
    yield best[1], best[2]


def sharpness(image: np.ndarray) -> float:
    """Return the variance of the Laplacian of an image [H, W, 3], in grey levels squared; higher is sharper."""
    step = max(1, round(max(image.shape[:2]) / JUDGED_SIZE))
    height, width = (side // step * step for side in image.shape[:2])
    grey = image[:height, :width].mean(axis=2, dtype=np.float32)
    grey = grey.reshape(height // step, step, width // step, step).mean(axis=(1, 3))
    laplacian = 4 * grey[1:-1, 1:-1] - grey[:-2, 1:-1] - grey[2:, 1:-1] - grey[1:-1, :-2] - grey[1:-1, 2:]
    return float(laplacian.var())
