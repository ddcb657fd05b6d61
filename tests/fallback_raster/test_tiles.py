"""Gaussians are listed in all tiles with a pixel at alpha >= 1/255, and in no tile that the ellipse does not reach."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from skipgs_plug.fallback_raster.runtime.constants import ALPHA_MIN, TILE, tiles
from skipgs_plug.fallback_raster.runtime.optimizations import without_optimizations
from skipgs_plug.fallback_raster.runtime.threads import get_num_threads, set_num_threads
from skipgs_plug.fallback_raster.stages.binning import Bins, bin_gaussians
from skipgs_plug.fallback_raster.stages.structs import Splats

SIZE = 330, 300  # 21 x 19 tiles: more rows than a vector has lanes, cut off on the right and below


def ellipses(n: int, seed: int) -> Splats:
    """Return 2D means, depths, conics, opacities and sigmas of points, discs and needles, from pixel to image size."""
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.rand(*shape, generator=generator, dtype=torch.float64)  # noqa: E731
    centres = draw(n, 2) * torch.tensor([420.0, 380.0]) - 40.0
    long = 0.5 * 200.0 ** draw(n)
    short, angle = torch.clamp(long * 0.02 ** draw(n), min=0.4), 2.0 * math.pi * draw(n)
    axes = torch.stack([torch.cos(angle), torch.sin(angle), -torch.sin(angle), torch.cos(angle)], 1).view(n, 2, 2)
    covariances = axes.mT @ torch.diag_embed(torch.stack([long, short], 1) ** 2) @ axes
    inverse = torch.linalg.inv(covariances)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], 1)
    sigmas = torch.diagonal(covariances, dim1=1, dim2=2).sqrt()
    given = centres, 1.0 + draw(n), conics, 0.9 * draw(n) + 0.005, sigmas
    return Splats(*(t.to(torch.float32) for t in given))


def listed_tiles(bins: Bins, n: int) -> Tensor:
    """Return how often each Gaussian [n] is listed in each tile. [n, tiles]"""
    bins.sort()
    count = len(bins.tile_start) - 1
    tile = torch.repeat_interleave(torch.arange(count), bins.tile_start.diff().long())
    row = bins.visible[bins.packed.listed[bins.tile_record.long()].long()].long()
    return torch.zeros(n, count, dtype=torch.int64).index_put_((row, tile), torch.tensor(1), accumulate=True)


def tiles_with(pixels: Tensor) -> Tensor:
    """Mask the tiles that contain one of the `pixels` [n, H, W]. [n, tiles]"""
    width, height = SIZE
    tiles_x, tiles_y = tiles(width, height)
    padded = torch.nn.functional.pad(pixels, (0, TILE * tiles_x - width, 0, TILE * tiles_y - height))
    return padded.view(-1, tiles_y, TILE, tiles_x, TILE).any(4).any(2).flatten(1)


def least_in_tiles(centres: Tensor, conics: Tensor, margin: float) -> Tensor:
    """Return the smallest squared distance in standard deviations in each tile's rectangle with a margin. [n, tiles]"""
    tiles_x, tiles_y = tiles(*SIZE)
    left = TILE * torch.arange(tiles_x, dtype=torch.float64).repeat(tiles_y) + 0.5 - margin - centres[:, :1]
    top = TILE * torch.arange(tiles_y, dtype=torch.float64).repeat_interleave(tiles_x) + 0.5 - margin - centres[:, 1:]
    side = TILE - 1.0 + 2.0 * margin
    a, b, c = (conics[:, i, None] for i in range(3))
    inside = (left <= 0) & (left + side >= 0) & (top <= 0) & (top + side >= 0)
    candidates = [torch.where(inside, 0.0, math.inf)]
    for x in (left, left + side):
        y = (-b / c * x).clamp(top, top + side)
        candidates.append(a * x * x + 2.0 * b * x * y + c * y * y)
    for y in (top, top + side):
        x = (-b / a * y).clamp(left, left + side)
        candidates.append(a * x * x + 2.0 * b * x * y + c * y * y)
    return torch.stack(candidates).amin(0)


@pytest.mark.parametrize("seed", range(4))
def test_tiles_of_ellipses(seed: int) -> None:
    n, (width, height) = 300, SIZE
    splats = ellipses(n, seed)
    centres, conics, opacities = splats.means2d, splats.conics, splats.opacities
    every = torch.arange(n, dtype=torch.int32)
    bins = bin_gaussians(every, splats, torch.rand(n, 3), width, height)
    found = listed_tiles(bins, n)

    x, y = torch.arange(width, dtype=torch.float64) + 0.5, torch.arange(height, dtype=torch.float64) + 0.5
    dx, dy = (centres.double()[:, i, None, None] - pixel for i, pixel in enumerate((x, y[:, None])))
    a, b, c = (conics.double()[:, i, None, None] for i in range(3))
    alpha = opacities.double()[:, None, None] * torch.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
    seen = alpha >= ALPHA_MIN
    assert found.max() == 1
    assert not (tiles_with(seen) & (found == 0)).any()
    least = least_in_tiles(centres.double(), conics.double(), margin=0.1)
    assert not ((found > 0) & (least > 2.0 * torch.log(opacities.double() / ALPHA_MIN)[:, None])).any()
    assert torch.equal(bins.tiles_per_gauss.long(), found.sum(1))
    assert torch.equal(bins.pairs.start.diff().long(), found.sum(1))
    large = found.view(n, -1, tiles(width, height)[0]).any(2).sum(1)
    assert (large > 16).any() and (large == 3).any() and (found.sum(1) == 1).any()


def test_without_the_test_of_ellipses_whole_boxes_are_listed() -> None:
    n, (width, height) = 300, SIZE
    rows = torch.arange(n, dtype=torch.int32), ellipses(n, 9), torch.rand(n, 3)
    exact = listed_tiles(bin_gaussians(*rows, width, height), n)
    with without_optimizations("exact_tiles"):
        boxes = listed_tiles(bin_gaussians(*rows, width, height), n)
    assert (boxes >= exact).all() and boxes.sum() > 1.2 * exact.sum()
    grid = boxes.view(n, -1, tiles(width, height)[0]) > 0
    assert torch.equal(grid.sum((1, 2)), grid.any(2).sum(1) * grid.any(1).sum(1))  # rectangles


def test_slices_of_threads_list_the_same() -> None:
    n, (width, height) = 3600, SIZE  # 1,200 are visible: fewer than 1,024 are one slice
    before, lists = get_num_threads(), []
    splats = ellipses(n, 10)
    visible = torch.arange(0, n, 3, dtype=torch.int32)
    try:
        for threads in (1, 3):
            set_num_threads(threads)
            bins = bin_gaussians(visible, splats, torch.rand(n, 3), width, height)
            lists.append((listed_tiles(bins, n), bins.tile_record.clone(), bins.tiles_per_gauss))
    finally:
        set_num_threads(before)
    assert torch.equal(lists[0][0], lists[1][0]) and torch.equal(lists[0][2], lists[1][2])
    assert lists[0][2][1::3].sum() == 0 and lists[0][2].sum() > n
