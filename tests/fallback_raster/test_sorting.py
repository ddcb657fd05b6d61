"""Tile lists are sorted front to back, equal depths in row order, for every distribution of depths."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from skipgs_plug.fallback_raster.stages.binning import bin_gaussians
from skipgs_plug.fallback_raster.stages.rows import all_rows
from skipgs_plug.fallback_raster.stages.structs import Splats

DEPTHS = {
    "spread": lambda n, g: 1.0 + 9.0 * torch.rand(n, generator=g),
    "all equal": lambda n, g: torch.full((n,), 3.0),
    "falling": lambda n, g: torch.linspace(10.0, 1.0, n),
    "falling in clusters": lambda n, g: (3.0 + 4.0 * (torch.arange(n) // 13) - 1e-3 * (torch.arange(n) % 13)).flip(0),
    "two values": lambda n, g: torch.randint(1, 3, (n,), generator=g).float(),
    "one far away": lambda n, g: torch.cat([1.0 + 1e-4 * torch.rand(n - 1, generator=g), torch.tensor([1e9])]),
    "clusters in clusters": lambda n, g: 1.0 + 10.0 ** -torch.randint(0, 8, (n,), generator=g).float(),
    "subnormal to huge": lambda n, g: 10.0 ** (80.0 * torch.rand(n, generator=g) - 42.0),
    "neighbouring floats": lambda n, g: (torch.randint(0, 40, (n,), generator=g).int() + 0x3F800000).view(
        torch.float32
    ),
}


@pytest.mark.parametrize("n", [1, 2, 9, 70, 5000, 20_000])
@pytest.mark.parametrize("case", DEPTHS)
def test_order(case: str, n: int) -> None:
    generator = torch.Generator().manual_seed(n)
    depths: Tensor = DEPTHS[case](n, generator)
    one = torch.ones(n, 2)
    conics = torch.tensor([1.0, 0.0, 1.0]).expand(n, 3).contiguous()
    # All Gaussians are in one of two tiles.
    splats = Splats(6.0 * one, depths, conics, torch.full((n,), 0.9), sigmas=one)
    bins = bin_gaussians(all_rows(n).rows, splats, torch.zeros(n, 3), width=32, height=16)
    bins.sort()
    assert bins.tile_start.tolist() == [0, n, n]
    assert torch.equal(bins.tile_record.long(), torch.argsort(depths, stable=True))
    assert torch.equal(bins.tile_pair, bins.tile_record)  # each Gaussian has one pair
