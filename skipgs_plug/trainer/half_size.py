"""Photographs of half the width and height, on which a scene can grow in less time."""

from __future__ import annotations

import torch
from torch import Tensor

from skipgs_plug.trainer.scene import MIN_SIDE, View


def half_size(view: View) -> View:
    """Return a view with a quarter of the pixels, each the mean of 2x2 pixels. An odd last row or column is left out.

    A pixel counts if all four pixels under it count. A view too small for SSIM at half the size is returned as it is.

    Args:
        view: The view. Its tensors stay on their device.
    """
    height, width = view.height // 2, view.width // 2
    if min(height, width) < MIN_SIDE:
        return view
    image = _sum_of_fours(view.image.to(torch.int16), height, width)
    K = view.K.clone()
    K[:2] *= 0.5
    mask = None if view.mask is None else _sum_of_fours(view.mask.to(torch.int16), height, width) == 4
    return View(view.name, ((image + 2) // 4).to(torch.uint8), K, view.viewmat, mask)


def _sum_of_fours(pixels: Tensor, height: int, width: int) -> Tensor:
    """Return the sum [height, width, ...] of each 2x2 pixels."""
    rows = pixels[0 : 2 * height : 2] + pixels[1 : 2 * height : 2]
    return rows[:, 0 : 2 * width : 2] + rows[:, 1 : 2 * width : 2]
