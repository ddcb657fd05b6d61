"""Stand-in for the rasterizer of Mip-Splatting, whose 2D filter has a given size and compensates opacities."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .settings import settings_class

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


# `kernel_size` is in square pixels, `subpixel_offset` [H, W, 2] in pixels.
GaussianRasterizationSettings = settings_class({"tanfovy": ("kernel_size", "subpixel_offset")})


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N]). Column 2 of the gradient of `means2D` is the sum of absolute gradients.

    Opacities are multiplied by the square root of the ratio of the covariances' determinants, without the small number
    (1e-6) that the CUDA code has there.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        if settings.subpixel_offset.any():
            raise NotImplementedError(
                "The CPU stand-in has no subpixel offsets: run without --ray_jitter, or with CUDA."
            )
        scene = splats(means3D, means2D, opacities, **gaussians)
        return render(settings, scene, antialiased=True, eps2d=settings.kernel_size, absgrad=True)[:2]
