"""Stand-in for the rasterizer of Taming 3DGS, which returns thirteen results. Four are sums over weighted pixels."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .settings import settings_class
from .sparse_adam import SparseGaussianAdam
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]


# `pixel_weights` is [H, W], or None: then the sums are empty.
GaussianRasterizationSettings = settings_class({"debug": ("pixel_weights",)})


class GaussianRasterizer(RasterizerModule):
    """Returns the CUDA module's 13-tuple.

    (color, radii, counts [H, W], three lists, centers [N, 2], depths [N], radii [N], accum_weights [N], accum_count
    [N], accum_blend [N], accum_dist [N]). The lists are always empty, as in the CUDA code. Counts and sums are empty
    without `pixel_weights`.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        result = render(self.raster_settings, splats(means3D, means2D, opacities, **gaussians))
        f, weights = result.footprint, self.raster_settings.pixel_weights
        whole, fraction = torch.empty(0, dtype=torch.int32), torch.empty(0)
        counts, sums = whole, (fraction, whole, fraction, fraction)
        if weights is not None and len(weights):
            found = gather(f, weights)
            counts, sums = found.contributions, (found.value, found.pixels, found.weight, found.distance)
        centers = f.means2d - 0.5  # in the CUDA code the first pixel centre is 0
        lists = (whole, fraction, fraction)
        return result.color, result.radii, counts, *lists, centers, f.depths, result.radii, *sums
