"""Stand-in for the rasterizer of Pixel-GS: pixel counts, and gradients of 2D means that are reduced near the camera."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .settings import settings_class
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


# `depth_threshold` is in world units. It is None in calls without gradients.
GaussianRasterizationSettings = settings_class({"scale_modifier": ("depth_threshold",)})


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], pixels [N, 1] float, the number of pixels that the Gaussian contributes to).

    The gradient of `means2D` is multiplied by (depth / depth_threshold)^2, at most 1.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        if means2D.requires_grad and settings.depth_threshold is not None:
            depth = means3D.detach() @ settings.viewmatrix[:3, 2] + settings.viewmatrix[3, 2]
            fading = (depth / settings.depth_threshold).square().clamp_max(1.0)[:, None]
            means2D = means2D.clone()
            means2D.register_hook(lambda gradient: gradient * fading)
        result = render(settings, splats(means3D, means2D, opacities, **gaussians))
        return result.color, result.radii, gather(result.footprint).pixels.float()[:, None]
