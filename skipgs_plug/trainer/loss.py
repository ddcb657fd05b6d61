"""Training loss in plain torch, for devices without a fused loss: (1 - w) L1 + w (1 - SSIM)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from skipgs_plug.core.ssim import C1, C2, RADIUS, SIGMA

WINDOW = 2 * RADIUS + 1  # pixels along each side of SSIM's window


def l1_ssim_loss(image: Tensor, target: Tensor, ssim_lambda: float = 0.2) -> Tensor:
    """Return the 3DGS loss of images [..., H, W, C] in [0, 1], the target also uint8; SSIM is zero-padded ("same")."""
    if target.dtype is torch.uint8:
        target = target.float() / 255.0
    l1 = (image - target).abs().mean()
    return (1.0 - ssim_lambda) * l1 + ssim_lambda * (1.0 - ssim(image, target))


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Return mean SSIM (Wang et al. 2004) with an 11x11 Gaussian window of sigma 1.5, zero padding."""
    height, width, channels = image.shape[-3:]
    x = image.reshape(-1, height, width, channels).permute(0, 3, 1, 2).reshape(-1, 1, height, width)
    y = target.reshape(-1, height, width, channels).permute(0, 3, 1, 2).reshape(-1, 1, height, width)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = blur(torch.stack((x, y, x * x, y * y, x * y)))
    var_x, var_y = mean_xx - mean_x * mean_x, mean_yy - mean_y * mean_y
    covariance = mean_xy - mean_x * mean_y
    numerator = (2 * mean_x * mean_y + C1) * (2 * covariance + C2)
    denominator = (mean_x * mean_x + mean_y * mean_y + C1) * (var_x + var_y + C2)
    return (numerator / denominator).mean()


def blur(maps: Tensor) -> Tensor:
    """Convolve the last two axes with the separable Gaussian window."""
    offsets = torch.arange(WINDOW, device=maps.device, dtype=maps.dtype) - WINDOW // 2
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = window / window.sum()
    # One image with many channels, each with its own copy of the window, is 20 times faster on the CPU than a batch.
    flat = maps.reshape(1, -1, *maps.shape[-2:])
    windows = window.expand(flat.shape[1], 1, 1, WINDOW)
    flat = F.conv2d(flat, windows.transpose(2, 3), padding=(WINDOW // 2, 0), groups=flat.shape[1])
    flat = F.conv2d(flat, windows, padding=(0, WINDOW // 2), groups=flat.shape[1])
    return flat.reshape(maps.shape)
