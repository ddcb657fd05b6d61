"""Stand-in for the rasterizer of Speedy-Splat, whose input `scores` receives sums of squared gradients."""

from __future__ import annotations

import time
from typing import Any

import torch
from torch import Tensor

from .compose import render, splats
from .inria import GaussianRasterizationSettings, RasterizerModule

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], kernel_times [1], the milliseconds of this forward pass)."""

    def forward(
        self, means3D: Tensor, means2D: Tensor, opacities: Tensor, scores: Tensor | None, **gaussians: Any
    ) -> tuple:
        start = time.perf_counter()
        scene = splats(means3D, means2D, opacities, scores=scores, **gaussians)
        result = render(self.raster_settings, scene)
        elapsed = torch.tensor([1000 * (time.perf_counter() - start)])
        return result.color, result.radii, elapsed
