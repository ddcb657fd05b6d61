"""Stand-in for `fused_ssim`."""

from __future__ import annotations

from typing import Literal

from torch import Tensor

from skipgs_plug.fallback_raster.runtime.function_modes import without_function_modes


@without_function_modes
def fused_ssim(img1: Tensor, img2: Tensor, padding: Literal["same", "valid"] = "same", train: bool = True) -> Tensor:
    """Return the mean SSIM (Wang et al. 2004, 11x11 Gaussian window). Differentiable in `img1`.

    Args:
        img1: Rendered images. [B, C, H, W]
        img2: Photographs. [B, C, H, W]
        padding: "same" continues images with black; "valid" only averages windows inside the image.
        train: Accepted for callers of the CUDA module and ignored: gradients are always available.
    """
    from skipgs_plug.fallback_raster import l1_ssim_loss

    first, second = (image.permute(0, 2, 3, 1).contiguous() for image in (img1, img2.detach()))
    return 1.0 - l1_ssim_loss(first, second, ssim_lambda=1.0, padding=padding)
