"""Stand-in for `diff_gaussian_rasterization_fastgs`, which counts per Gaussian the pixels of a map of poor pixels.

`mult` shrinks the box of tiles that the CUDA kernel visits. The stand-in visits all tiles, as with `mult=1`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .sparse_adam import SparseGaussianAdam
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]


class GaussianRasterizationSettings(NamedTuple):
    """Settings of a call, with the fields of the CUDA module."""

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
    mult: float
    prefiltered: bool
    debug: bool
    get_flag: bool | None
    metric_map: Tensor | None  # [H * W], 1 for pixels that count


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], accum_metric_counts [N]). The counts are empty without `get_flag`."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        result = render(settings, splats(means3D, means2D, opacities, **gaussians))
        counts = torch.empty(0, dtype=torch.int32)
        if settings.get_flag:
            counts = gather(result.footprint, settings.metric_map == 1).value.to(torch.int32)
        return result.color, result.radii, counts
