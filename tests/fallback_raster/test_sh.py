"""Colours from spherical harmonics: bit-equal for every layout of the bands, and independent of neighbouring rows."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import random_scene
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization

# Numbers of rows that end inside 16 rows, inside a block of 512, and after it.
ROWS = (1, 37, 517)
# Degree, and number of coefficients in a row: some are not used, or no degree has as many.
BANDS = ((0, 1), (0, 16), (1, 4), (1, 9), (2, 9), (2, 16), (3, 16), (3, 20))


def scene_with(n: int, coefficients: int) -> dict[str, Any]:
    scene = random_scene(n=n, sh_degree=3)
    generator = torch.Generator().manual_seed(7)
    return scene | {"colors": 0.4 * torch.randn(n, coefficients, 3, generator=generator)}


def rendered(scene: dict[str, Any], colors: Tensor | tuple[Tensor, Tensor], degree: int) -> tuple[Tensor, Tensor]:
    """Return the image and the gradient of the means."""
    means = scene["means"].clone().requires_grad_()
    image, _, _ = rasterization(**(scene | {"means": means, "colors": colors, "sh_degree": degree}))
    image.square().sum().backward()
    assert means.grad is not None
    return image.detach(), means.grad


@pytest.mark.parametrize(("degree", "coefficients"), BANDS)
@pytest.mark.parametrize("n", ROWS)
def test_bands_may_lie_together_or_apart(n: int, degree: int, coefficients: int) -> None:
    scene = scene_with(n, coefficients)
    joined = scene["colors"].clone().requires_grad_()
    pair = [scene["colors"][:, part].clone().requires_grad_() for part in (slice(0, 1), slice(1, None))]
    one, other = rendered(scene, joined, degree), rendered(scene, (pair[0], pair[1]), degree)
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    found = torch.cat([part.grad for part in pair if part.grad is not None], dim=1)
    assert joined.grad is not None and torch.equal(joined.grad, found)
    used = (degree + 1) ** 2
    assert bool(found[:, :used].any()) and not found[:, used:].any()


@pytest.mark.parametrize(("degree", "coefficients"), BANDS)
def test_a_row_has_the_colour_that_it_has_alone(degree: int, coefficients: int) -> None:
    """Gaussians without overlap: the 16 rows of a vector do not affect each other."""
    n = 37
    scene = scene_with(n, coefficients)
    columns = torch.arange(n, dtype=torch.float32)
    scene |= {
        "means": torch.stack([columns * 0.2 - 3.6, torch.zeros(n), torch.full((n,), 4.0)], dim=1),
        "scales": torch.full((n, 3), 0.005),
        "opacities": torch.full((n,), 0.9),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[160.0, 0, 148.0], [0, 160.0, 4.0], [0, 0, 1]]]),
        "width": 296,
        "height": 8,
    }
    image, _ = rendered(scene, scene["colors"], degree)
    lit = 0
    for row in range(n):
        rows = {name: scene[name][row : row + 1] for name in ("means", "quats", "scales", "opacities", "colors")}
        alone, _ = rendered(scene | rows, rows["colors"], degree)
        where = slice(8 * row, 8 * row + 8)
        assert torch.equal(alone[0, :, where], image[0, :, where])
        lit += bool(alone[0, :, where].any())
    assert lit > 30  # the others are clamped at 0
