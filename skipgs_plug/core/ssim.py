"""SSIM with the results of torchmetrics 1.9, without importing torchmetrics.

It imports SciPy's signal processing and matplotlib, which takes longer than an evaluation.
"""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor
from torch.nn import functional

# Sigma and radius of SSIM's Gaussian window, in pixels. The window has 11 pixels along each side (Wang et al. 2004).
SIGMA, RADIUS = 1.5, 5
# Terms that keep SSIM's quotients finite where an image is flat; the paper's values for images in [0, 1].
C1, C2 = 0.01**2, 0.03**2
# Rows and columns of an image that are measured together. Their fifteen planes of products stay in the cache of a core:
# a photograph of 3 megapixels takes 0.46 instead of 2.9 seconds in bands of 2^18 pixels, with the same bits. A GPU is
# kept busy by larger blocks; all planes of a photograph of 12 megapixels would take 7 GiB.
BLOCK, GPU_BLOCK = (64, 128), (1024, 1024)


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Return the SSIM [H, W, 3] of the window around each pixel, for two images [H, W, 3] in [0, 1].

    Windows are Gaussian, of 11x11 pixels. The image is reflected at its border. It is measured in blocks.
    """
    images = torch.stack([image.permute(2, 0, 1) for image in (first, second)])  # [2, 3, H, W]
    padded = functional.pad(images, (RADIUS,) * 4, mode="reflect")
    found = torch.empty_like(images[0])
    height, width = BLOCK if images.device.type == "cpu" else GPU_BLOCK
    for top, left in product(range(0, images.shape[2], height), range(0, images.shape[3], width)):
        rows, columns = slice(top, top + height), slice(left, left + width)
        found[:, rows, columns] = _inner_windows(padded[:, :, _wider(rows), _wider(columns)])
    return found.permute(1, 2, 0)


def _wider(block: slice) -> slice:
    """Return the rows or columns of a padded image that the windows around those of a block cover."""
    return slice(block.start, block.stop + 2 * RADIUS)


def _inner_windows(images: Tensor) -> Tensor:
    """Return the SSIM of the windows that lie inside two images: [2, 3, H, W] -> [3, H - 10, W - 10]."""
    one, other = images
    planes = torch.stack([one, other, one * one, other * other, one * other]).flatten(0, 1)[:, None]
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=images.dtype, device=images.device)
    window = torch.exp(-((offsets / SIGMA) ** 2) / 2)
    window = window / window.sum()
    # Two passes of 11 products each are four times as fast as one of 121, and equal to rounding.
    planes = functional.conv2d(planes, window[None, None, None, :])
    planes = functional.conv2d(planes, window[None, None, :, None])
    mean1, mean2, square1, square2, both = planes[:, 0].unflatten(0, (5, 3))  # [3, H, W] each
    variances = (square1 - mean1**2).clamp(min=0.0) + (square2 - mean2**2).clamp(min=0.0)
    above = (2 * mean1 * mean2 + C1) * (2 * (both - mean1 * mean2) + C2)
    below = (mean1**2 + mean2**2 + C1) * (variances + C2)
    return above / below
