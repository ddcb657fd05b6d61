"""Pixels that do not count, such as people who walked by, sky, or the rig."""

from __future__ import annotations

import torch
from torch import Tensor


def leave_out(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return both images [H, W, 3], black where `mask` [H, W] is False, so that these pixels give no loss or gradient.

    Means still run over all pixels, so the weight of a view is its share of visible pixels.
    """
    if mask is None:
        return image, target
    kept = mask.to(image.device)[..., None]
    return torch.where(kept, image, torch.zeros_like(image)), torch.where(kept, target, torch.zeros_like(target))
