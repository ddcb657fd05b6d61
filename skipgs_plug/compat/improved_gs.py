"""Stand-in for the rasterizer of Improved-GS: the results of Taming 3DGS, with weights summed while blending."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .compose import render, splats
from .inria import RasterizerModule
from .sparse_adam import SparseGaussianAdam
from .statistics import gather
from .taming import GaussianRasterizationSettings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "SparseGaussianAdam"]


class GaussianRasterizer(RasterizerModule):
    """Returns the CUDA module's 13-tuple, of which the trainer reads color, radii and accum_weights [N].

    accum_weights is the sum over pixels of `pixel_weights` times blend weight. It is empty without `pixel_weights`, and
    entries that the trainer does not read are always empty. `means2D` is [N, 4]. Columns 2 and 3 receive absolute
    gradients.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        result = render(self.raster_settings, splats(means3D, means2D, opacities, **gaussians))
        f, weights = result.footprint, self.raster_settings.pixel_weights
        empty = torch.empty(0)
        sums = empty
        if weights is not None and len(weights):
            sums = gather(f, weights).weighted_value
        centers = f.means2d - 0.5  # in the CUDA code the first pixel centre is 0
        unread = (empty,) * 3
        return result.color, result.radii, empty, *unread, centers, f.depths, result.radii, sums, *unread
