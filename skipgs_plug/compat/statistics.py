"""Per-Gaussian sums over pixels that the CUDA forks collect inside their blend kernels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.runtime.buffers import floats, ints, zeros
from skipgs_plug.fallback_raster.stages.binning import bin_gaussians
from skipgs_plug.fallback_raster.stages.statistics import (
    STATISTICS,
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
    """Sums over the pixels that each Gaussian contributes to, and two maps."""

    pixels: Tensor  # [N] int32, number of pixels
    weight: Tensor  # [N] sum of blend weights
    light: Tensor  # [N] sum of transmittances in front of the Gaussian
    value: Tensor  # [N] sum of the values given for the pixels
    weighted_value: Tensor  # [N] sum of value times blend weight
    distance: Tensor  # [N] sum of distances from pixel centres to the 2D mean, pixels
    contributions: Tensor  # [H, W] int32, number of Gaussians that contribute
    strongest: Tensor  # [H, W] int32, row with the largest blend weight, the front one of equals; -1 if there is none


@torch.no_grad()
def gather(f: Footprint, values: Tensor | None = None) -> Statistics:
    """Blend an image once more without colours, and collect statistics.

    Args:
        f: The projected scene.
        values: One number per pixel, H * W numbers in any shape; zeros if None.
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
    columns = total[:, : len(STATISTICS)].unbind(dim=1)
    count, weight, light, value, weighted, distance = (column.contiguous() for column in columns)
    return Statistics(count.to(torch.int32), weight, light, value, weighted, distance, *maps)
