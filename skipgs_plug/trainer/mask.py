"""Pixels that do not count: people who walked by, sky, the rig."""

from __future__ import annotations

import torch
from torch import Tensor


def leave_out(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return both images [H, W, 3] black where `mask` [H, W] is False: no loss and no gradient comes from there.

    Means still run over all pixels, so a view weighs as much as is seen of it.
    """
    if mask is None:
        return image, target
    kept = mask.to(image.device)[..., None]
    return torch.where(kept, image, torch.zeros_like(image)), torch.where(kept, target, torch.zeros_like(target))
