"""Stand-in for `diff_gaussian_rasterization_abs` of AbsGS, which returns absolute gradients and blend weights."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from .compose import render, splats
from .inria import GaussianRasterizationSettings, RasterizerModule
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], gs_w [N]), where gs_w is the sum of blend weights over the pixels.

    `means2D` is [N, 4]. Columns 2 and 3 receive absolute gradients.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        result = render(self.raster_settings, splats(means3D, means2D, opacities, **gaussians))
        return result.color, result.radii, gather(result.footprint).weight
