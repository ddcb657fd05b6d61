"""SSIM with the results of torchmetrics 1.9, without importing torchmetrics.

It imports SciPy's signal processing and matplotlib, which takes longer than an evaluation.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# Sigma and radius of SSIM's Gaussian window, in pixels. The window has 11 pixels along each side (Wang et al. 2004).
SIGMA, RADIUS = 1.5, 5
# Terms that keep SSIM's quotients finite where an image is flat; the paper's values for images in [0, 1].
C1, C2 = 0.01**2, 0.03**2
BAND = 1 << 18  # pixels of an image that are measured together: all planes of a photograph of 12 megapixels take 7 GiB


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Return the SSIM [H, W, 3] of the window around each pixel, for two images [H, W, 3] in [0, 1].

    Windows are Gaussian, of 11x11 pixels. The image is reflected at its border. Large images are measured in bands of
    rows.
    """
    images = torch.stack([image.permute(2, 0, 1) for image in (first, second)])  # [2, 3, H, W]
    height, width = images.shape[2:]
    rows = max(1, BAND // width)
    padded = functional.pad(images, (RADIUS,) * 4, mode="reflect")
    found = torch.empty_like(images[0])
    for top in range(0, height, rows):
        found[:, top : top + rows] = _inner_windows(padded[:, :, top : top + rows + 2 * RADIUS])
    return found.permute(1, 2, 0)


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
    mean1, mean2, square1, square2, product = planes[:, 0].unflatten(0, (5, 3))  # [3, H, W] each
    variances = (square1 - mean1**2).clamp(min=0.0) + (square2 - mean2**2).clamp(min=0.0)
    above = (2 * mean1 * mean2 + C1) * (2 * (product - mean1 * mean2) + C2)
    below = (mean1**2 + mean2**2 + C1) * (variances + C2)
    return above / below
