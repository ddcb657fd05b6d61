"""Stand-in for `fused_ssim`."""

from __future__ import annotations

from typing import Literal

from torch import Tensor


def fused_ssim(img1: Tensor, img2: Tensor, padding: Literal["same", "valid"] = "same", train: bool = True) -> Tensor:
    """Mean structural similarity, 11x11 Gaussian window; differentiable in `img1`.

    Args:
        img1: [B, C, H, W]
        img2: [B, C, H, W]
        padding: "same" or "valid".
        train: Accepted as the CUDA module does; gradients are there either way.
    """
    from skipgs_plug.fallback_raster import l1_ssim_loss

    first, second = (image.permute(0, 2, 3, 1).contiguous() for image in (img1, img2.detach()))
    return 1.0 - l1_ssim_loss(first, second, ssim_lambda=1.0, padding=padding)
