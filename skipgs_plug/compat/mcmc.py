"""Stand-in for the rasterizer of 3DGS-MCMC: classic Inria, with flags of drawn Gaussians and relocation."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from . import relocation
from .compose import render, splats
from .inria import GaussianRasterizationSettings, RasterizerModule
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "compute_relocation"]


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N], is_used [N] int32, 1 if the Gaussian contributes to a pixel)."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        result = render(self.raster_settings, splats(means3D, means2D, opacities, **gaussians))
        return result.color, result.radii, (gather(result.footprint).pixels > 0).to(torch.int32)


def compute_relocation(
    opacity_old: Tensor, scale_old: Tensor, N: Tensor, binoms: Tensor, n_max: int
) -> tuple[Tensor, Tensor]:
    """Return opacities [M] or [M, 1] and scales [M, 3] of Gaussians that are split into `N` [M] equal ones."""
    return relocation.compute_relocation(opacity_old, scale_old, N, binoms[:n_max, :n_max])
