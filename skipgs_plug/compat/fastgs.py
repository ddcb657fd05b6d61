"""Stand-in for `diff_gaussian_rasterization_fastgs`, which counts per Gaussian the pixels of a map of poor pixels.

`mult` shrinks the box of tiles that the CUDA kernel visits. The stand-in visits all tiles, as with `mult=1`.
"""

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


# `metric_map` [H * W] is 1 for pixels that count. Both it and `get_flag` may be None.
GaussianRasterizationSettings = settings_class({"campos": ("mult",), "debug": ("get_flag", "metric_map")})


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], accum_metric_counts [N]). The counts are empty without `get_flag`."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        result = render(settings, splats(means3D, means2D, opacities, **gaussians))
        counts = torch.empty(0, dtype=torch.int32)
        if settings.get_flag:
            counts = gather(result.footprint, settings.metric_map == 1).value.to(torch.int32)
        return result.color, result.radii, counts
