"""Sums over the pixels of each Gaussian that the CUDA forks gather inside their blend kernels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.runtime.buffers import floats, ints, zeros
from skipgs_plug.fallback_raster.stages.binning import bin_gaussians
from skipgs_plug.fallback_raster.stages.statistics import (
    STATISTICS_FLOATS,
    SortedLists,
    StatisticsMaps,
    blend_statistics,
)
from skipgs_plug.fallback_raster.stages.structs import Splats


class Footprint(NamedTuple):
    """Gaussians on one image plane, without gradients."""

    means2d: Tensor  # [N, 2] pixels, the first pixel centre at 0.5
    conics: Tensor  # [N, 3] inverse 2D covariance: xx, xy, yy
    opacities: Tensor  # [N]
    depths: Tensor  # [N]
    drawn: Tensor  # [N] bool
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.depths)


class Statistics(NamedTuple):
    """Sums over the pixels that a Gaussian contributes to, and two maps."""

    pixels: Tensor  # [N] int32, their number
    weight: Tensor  # [N] sum of its shares of their colour
    light: Tensor  # [N] sum of the light that reaches it
    value: Tensor  # [N] sum of the values given for the pixels
    weighted_value: Tensor  # [N] sum of value times share
    distance: Tensor  # [N] sum of the distances of the pixels' centres from its own
    contributions: Tensor  # [H, W] int32, Gaussians that contribute to a pixel
    strongest: Tensor  # [H, W] int32, the one with the largest share, the front one of equals; -1 where there is none


@torch.no_grad()
def gather(f: Footprint, values: Tensor | None = None) -> Statistics:
    """Walk through the blend of an image once more, and sum what is asked of it.

    Args:
        f: The projected scene.
        values: One number for each pixel, H * W of them in any shape; zeros when left out.
    """
    a, b, c = f.conics.unbind(-1)
    determinant = torch.where(f.drawn, a * c - b * b, 1.0)
    sigmas = (torch.stack([c, a], dim=-1) / determinant[:, None]).clamp_min(0.0).sqrt()
    visible = f.drawn.nonzero()[:, 0].to(torch.int32)
    means2d, depths, conics, opacities = (t.contiguous() for t in (f.means2d, f.depths, f.conics, f.opacities))
    splats = Splats(means2d, depths, conics, opacities, sigmas)
    bins = bin_gaussians(visible, splats, zeros(len(f), 1), f.width, f.height)
    bins.sort()
    rows = visible[bins.packed.listed[bins.tile_record]]
    size = (f.height, f.width)
    picture = zeros(*size) if values is None else values.detach().to(torch.float32).reshape(size).contiguous()
    pair_sums, maps = floats(len(rows), STATISTICS_FLOATS), StatisticsMaps(ints(*size), ints(*size))
    blend_statistics(
        lists=SortedLists(bins.packed.records, bins.tile_start, bins.tile_record, rows),
        values=picture,
        pair_sums=pair_sums,
        maps=maps,
        grid=bins.grid,
    )
    total = zeros(len(f), STATISTICS_FLOATS).index_add_(0, rows, pair_sums)
    count, weight, light, value, weighted, distance = (column.contiguous() for column in total[:, :6].unbind(dim=1))
    return Statistics(count.to(torch.int32), weight, light, value, weighted, distance, *maps)
