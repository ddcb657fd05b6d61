"""Stand-in for the rasterizer of LightGaussian, which counts the importance of each Gaussian with `f_count`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .settings import settings_class
from .statistics import gather

# `f_count` is whether the call counts the importance of each Gaussian.
GaussianRasterizationSettings = settings_class({"debug": ("f_count",)})


class GaussianRasterizer(RasterizerModule):
    """Returns (color, radii), or with `f_count` (gaussians_count [N], important_score [N], color, radii)."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        scene = splats(means3D, means2D, opacities, **gaussians)
        if not settings.f_count:
            return render(settings, scene)[:2]
        with torch.no_grad():  # the CUDA counting pass is outside autograd
            result = render(settings, scene)
        found = gather(result.footprint)
        # Per pixel, the CUDA kernel adds opacity times transmittance to the importance.
        return found.pixels, result.footprint.opacities * found.light, result.color, result.radii
