"""Stand-ins for the imports of Scaffold-GS: its rasterizer, and one function of torch_scatter."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from . import inria
from .compose import render, splats
from .inria import GaussianRasterizationSettings

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer", "scatter_max"]


class GaussianRasterizer(inria.GaussianRasterizer):
    """Inria's classic rasterizer, with a filter for anchors."""

    @torch.no_grad()
    def visible_filter(self, means3D: Tensor, scales: Tensor, rotations: Tensor, cov3D_precomp: Any = None) -> Tensor:
        """Return radii in pixels as if all Gaussians were opaque; 0 outside the image. [N] int32"""
        opaque, black = torch.ones(len(means3D), 1), torch.zeros(len(means3D), 3)
        scene = splats(means3D, torch.zeros_like(means3D), opaque, colors_precomp=black, scales=scales,
                       rotations=rotations, cov3D_precomp=cov3D_precomp)  # fmt: skip
        return render(self.raster_settings, scene).radii


def scatter_max(src: Tensor, index: Tensor, dim: int) -> tuple[Tensor, None]:
    """Return the largest value of each group along `dim`, and None in place of torch_scatter's argmax.

    Args:
        src: Values.
        index: Group of each value, of the shape of `src`.
        dim: Dimension along which groups lie.
    """
    size = list(src.shape)
    size[dim] = int(index.max()) + 1 if index.numel() else 0
    return torch.zeros(size, dtype=src.dtype).scatter_reduce(dim, index, src, "amax", include_self=False), None
