"""Photographs of half the width and height, on which a scene grows in less time."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor
from torch.nn import functional

# Least PSNR in decibels, against themselves, of photographs that were halved and enlarged again. Growth on photographs
# of half the size cost at most 0.06 dB with 34.1 dB (ray-traced 640x480) and 32.7 dB (bonsai 798x531). It cost 0.13 dB
# with 30.9 dB (bonsai 532x354), 0.17 with 30.0 (ray-traced 240x180), 0.3 with 29.0 and 25.5 (bonsai 399x266, fern).
LEAST_PSNR = 32.0
# Number of photographs that decide. They are spread evenly over all.
JUDGED = 8
# Least side in pixels of a photograph at half the size: the window of SSIM.
LEAST_SIDE = 11


def halved(pixels: Tensor) -> Tensor:
    """Return values on half as many pixels in each direction, rounded down. Each is the mean of those under it.

    Args:
        pixels: Values [..., H, W]. Floats, or True where a pixel counts.

    Returns:
        Values [..., H // 2, W // 2] of the same type. A pixel counts if all pixels under it count.
    """
    size = pixels.shape[-2] // 2, pixels.shape[-1] // 2
    # The pooling takes images [N, C, H, W].
    images = pixels.reshape(1, -1, *pixels.shape[-2:])
    if pixels.dtype == torch.bool:
        return (functional.adaptive_avg_pool2d(images.float(), size) == 1.0).reshape(*pixels.shape[:-2], *size)
    return functional.adaptive_avg_pool2d(images, size).reshape(*pixels.shape[:-2], *size)


def can_be_halved(height: int, width: int) -> bool:
    """Return whether a photograph of this size is large enough for SSIM at half the size."""
    return min(height, width) // 2 >= LEAST_SIDE


def half_size_psnr(photographs: Iterable[Tensor]) -> float:
    """Return how much of photographs is left at half their size: the mean PSNR in decibels after enlarging them again.

    Args:
        photographs: Photographs [3, H, W] with values in [0, 1], at least one.
    """
    values = []
    for photograph in photographs:
        image = photograph[None].float()
        again = functional.interpolate(halved(image), image.shape[-2:], mode="bicubic", align_corners=False)
        error = float((again - image).square().mean())
        values.append(-10.0 * math.log10(max(error, 1e-10)))
    return sum(values) / len(values)


def keep_detail(psnr: float) -> bool:
    """Return whether photographs with this `half_size_psnr` keep enough for a scene to grow on them at half size."""
    return psnr >= LEAST_PSNR


def in_unit_range(pixels: Tensor) -> Tensor:
    """Return a photograph [3, H, W] with values in [0, 1], from one [H, W, 3] with values in [0, 255]."""
    return pixels.movedim(-1, 0) / 255.0


def some_of(count: int) -> list[int]:
    """Return the positions of at most `JUDGED` photographs out of `count`, spread evenly."""
    judged = min(JUDGED, count)
    return [round(i * (count - 1) / max(judged - 1, 1)) for i in range(judged)]
