"""Stand-in for the rasterizer of LightGaussian: `f_count` turns a render into an importance count."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .statistics import gather


class GaussianRasterizationSettings(NamedTuple):
    """Fields as in the CUDA module."""

    image_height: int
    image_width: int
    tanfovx: float
    tanfovy: float
    bg: Tensor
    scale_modifier: float
    viewmatrix: Tensor
    projmatrix: Tensor
    sh_degree: int
    campos: Tensor
    prefiltered: bool
    debug: bool
    f_count: bool


class GaussianRasterizer(RasterizerModule):
    """Returns (color, radii); with `f_count` (gaussians_count [N], important_score [N], color, radii)."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        scene = splats(means3D, means2D, opacities, **gaussians)
        if not settings.f_count:
            return render(settings, scene)[:2]
        with torch.no_grad():  # the CUDA counting pass is outside autograd
            result = render(settings, scene)
        found = gather(result.footprint)
        # Opacity times the light that arrives: the importance the CUDA kernel adds per pixel.
        return found.pixels, result.footprint.opacities * found.light, result.color, result.radii
