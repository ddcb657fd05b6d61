"""Photographs of half the width and height, on which a scene grows in less time."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from skipgs_plug.core import distributed
from skipgs_plug.core.ssim import ssim_map

# Least PSNR in decibels, against themselves, of photographs that were halved and enlarged again. Growth on photographs
# of half the size cost at most 0.06 dB with 34.1 dB (ray-traced 640x480) and 32.7 dB (bonsai 798x531). It cost 0.13 dB
# with 30.9 dB (bonsai 532x354), 0.17 with 30.0 (ray-traced 240x180), 0.3 with 29.0 and 25.5 (bonsai 399x266, fern).
LEAST_PSNR = 32.0
# Least SSIM of the same. Large plain areas raise the PSNR of photographs whose details are lost: those of a fox's head
# in front of a wall, 270x480, keep 32.2 dB and .898. Growth on half the size cost gsplat's script 0.5 dB and .005 SSIM
# there. Bonsai at 798x531 keeps .928, bonsai at 532x354 .903.
LEAST_SSIM = 0.92
# Number of photographs that decide. They are spread evenly over all.
JUDGED = 8
# Pixels of a photograph that are judged. Of a larger one, they are in tiles that are spread evenly, three along each
# side. Eight whole photographs of 12 megapixels took 100 seconds of a processor.
MOST_PIXELS, TILES = 1 << 19, 3
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


class Kept(NamedTuple):
    """What photographs keep at half their size: means over the photographs, against themselves.

    Attributes:
        psnr: PSNR in decibels.
        ssim: SSIM; None if the PSNR alone decides.
    """

    psnr: float
    ssim: float | None

    @property
    def enough(self) -> bool:
        """Whether a scene may grow on such photographs."""
        return self.psnr >= LEAST_PSNR and self.ssim is not None and self.ssim >= LEAST_SSIM


def kept_at_half_size(photographs: Callable[[], Iterable[Tensor]]) -> Kept:
    """Return what photographs keep if their size is halved. All processes must call it together.

    SSIM is computed only where the PSNR suffices, which it mostly does not.

    Args:
        photographs: Returns photographs [3, H, W] with values in [0, 1], at least one.
    """
    judged = [judged_tiles(photograph) for photograph in photographs()]
    (psnr,) = distributed.mean(torch.tensor([_mean(map(psnr_at_half_size, judged))]))
    if psnr < LEAST_PSNR:
        return Kept(psnr, None)
    (ssim,) = distributed.mean(torch.tensor([_mean(map(ssim_at_half_size, judged))]))
    return Kept(psnr, ssim)


def judged_tiles(photograph: Tensor) -> list[Tensor]:
    """Return the parts of a photograph [3, H, W] that are judged: all of it, or tiles of equal size."""
    height, width = photograph.shape[-2:]
    if height * width <= MOST_PIXELS:
        return [photograph]
    part = math.sqrt(MOST_PIXELS / (height * width)) / TILES
    rows, columns = (min(size, max(int(part * size), 2 * LEAST_SIDE)) for size in (height, width))
    tops, lefts = (
        [round(i * (size - side) / (TILES - 1)) for i in range(TILES)]
        for size, side in ((height, rows), (width, columns))
    )
    # Copies, so that the photograph itself is not kept.
    return [photograph[:, y : y + rows, x : x + columns].clone() for y in tops for x in lefts]


def psnr_at_half_size(tiles: Sequence[Tensor]) -> float:
    """Return the PSNR in decibels of the tiles of a photograph, halved and enlarged again, against themselves."""
    error = _mean(float((again - image).square().mean()) for again, image in map(_halved_and_enlarged, tiles))
    return -10.0 * math.log10(max(error, 1e-10))


def ssim_at_half_size(tiles: Sequence[Tensor]) -> float:
    """Return the SSIM of the tiles of a photograph, halved and enlarged again, against themselves."""
    pairs = map(_halved_and_enlarged, tiles)
    return _mean(float(ssim_map(again.permute(1, 2, 0), image.permute(1, 2, 0)).mean()) for again, image in pairs)


def _mean(values: Iterable[float]) -> float:
    found = list(values)
    return sum(found) / len(found)


def _halved_and_enlarged(tile: Tensor) -> tuple[Tensor, Tensor]:
    """Return a tile [3, H, W] after both, and as it is."""
    image = tile.float()
    again = functional.interpolate(halved(image)[None], image.shape[-2:], mode="bicubic", align_corners=False)[0]
    return again, image


def in_unit_range(pixels: Tensor) -> Tensor:
    """Return a photograph [3, H, W] with values in [0, 1], from one [H, W, 3] with values in [0, 255]."""
    return pixels.movedim(-1, 0) / 255.0


def some_of(count: int) -> list[int]:
    """Return the positions of at most `JUDGED` photographs out of `count`, spread evenly."""
    judged = min(JUDGED, count)
    return [round(i * (count - 1) / max(judged - 1, 1)) for i in range(judged)]
