"""Rows are culled 16 at a time as spheres. The image equals that of all rows to the bit."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from raster_scenes import leaves, random_scene
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.optimizations import without_optimizations


def rendered(scene: dict[str, Any], **options: Any) -> list[Tensor]:
    """Return all results and all gradients."""
    inputs = leaves(scene, torch.float32, ("viewmats",))
    image, alpha, info = rasterization(**inputs, packed=False, **options)
    (image.sum() + alpha.sum()).backward()
    found = [image.detach(), alpha.detach()]
    found += [info[name].detach() for name in ("radii", "means2d", "depths", "conics", "tiles_per_gauss")]
    return found + [t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None]


def assert_equal_without(scene: dict[str, Any], **options: Any) -> Tensor:
    """Compare all results with and without the optimization, and return the radii."""
    with_spheres = rendered(scene, **options)
    with without_optimizations("spheres"):
        without = rendered(scene, **options)
    for value, other in zip(with_spheres, without, strict=True):
        assert torch.equal(value.nan_to_num(nan=7e30), other.nan_to_num(nan=7e30))
    return with_spheres[2]


def sixteen_alike(scene: dict[str, Any], spread: float) -> dict[str, Any]:
    """Replace every row by 16 neighbouring rows at nearly the same position."""
    n = len(scene["means"])
    generator = torch.Generator().manual_seed(2)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        scene[name] = scene[name].repeat_interleave(16, dim=0)
    scene["means"] = scene["means"] + spread * torch.randn(16 * n, 3, generator=generator)
    return scene


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    distance=st.floats(0.0, 12.0),
    log_size=st.floats(-6.0, 3.0),
    needle=st.floats(0.0, 4.0),
    spread=st.sampled_from([0.0, 0.05, 1.0]),
    antialiased=st.booleans(),
    cameras=st.integers(1, 3),
)
def test_no_visible_row_is_left_out(
    seed: int, distance: float, log_size: float, needle: float, spread: float, antialiased: bool, cameras: int
) -> None:
    """Groups on all sides of the frustum's border, inside and far outside, from dust to giants and needles."""
    generator = torch.Generator().manual_seed(seed)
    scene = random_scene(n=40, cameras=cameras, seed=seed)
    scene["means"] = scene["means"] * (0.5 + distance)
    scene["scales"] = torch.exp(log_size - needle * torch.rand(40, 3, generator=generator))
    scene = sixteen_alike(scene, spread)
    assert_equal_without(scene, rasterize_mode="antialiased" if antialiased else "classic")


def test_giants_far_outside_reach_in() -> None:
    scene = random_scene(n=4)
    scene["means"] = torch.tensor([[40.0, 0, 20], [-40, 3, 20], [5, 60, 30], [300, 300, 20]])
    scene["scales"] = torch.tensor([[30.0, 1, 1], [0.1, 0.1, 0.1], [2, 50, 2], [0.1, 0.1, 0.1]])
    scene["quats"] = torch.tensor([[1.0, 0, 0, 0]]).expand(4, 4).contiguous()
    scene["viewmats"] = torch.eye(4)[None]
    radii = assert_equal_without(sixteen_alike(scene, 0.01))
    seen = (radii[0] > 0).all(dim=-1).view(4, 16).any(dim=1)
    assert seen.tolist() == [True, False, True, False]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "scales", "quats", "opacities"])
def test_rows_that_are_no_numbers(name: str, value: float) -> None:
    scene = sixteen_alike(random_scene(n=20), 0.01)
    scene[name][5::7] = value
    assert_equal_without(scene)


def test_rows_moved_in_place_are_seen_where_they_are() -> None:
    """No state can become outdated: an optimizer moves rows into view and out of it between two images."""
    scene = sixteen_alike(random_scene(n=60), 0.02)
    for step in range(3):
        scene["means"] += torch.tensor([1.5 * (-1) ** step, 0.7, 0.0])
        scene["scales"] *= 1.8
        assert_equal_without(scene)
