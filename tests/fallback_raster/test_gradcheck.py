"""The reference's autograd gradients against finite differences in float64, away from every cut-off."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import leaves, random_scene

from skipgs_plug.fallback_raster.oracle import torch_reference
from skipgs_plug.fallback_raster.oracle.torch_reference import near_cutoff, rasterization_reference

STEP = 1e-6

CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "plain colors": ({"backgrounds": True}, {}),
    "SH 3": ({"sh_degree": 3}, {"packed": False}),
    "antialiased": ({}, {"rasterize_mode": "antialiased"}),
    "RGB+ED": ({"backgrounds": True}, {"render_mode": "RGB+ED"}),
    "D, two cameras": ({"cameras": 2}, {"render_mode": "D"}),
    "absgrad does not change the gradient": ({}, {"absgrad": True}),
}


@pytest.mark.parametrize("case", CASES)
def test_finite_differences(case: str) -> None:
    scene_options, options = CASES[case]
    inputs = leaves(random_scene(n=8, width=8, height=7, seed=5, **scene_options), torch.float64, ("viewmats",))
    names = [name for name, t in inputs.items() if torch.is_tensor(t) and t.requires_grad]
    *_, info = rasterization_reference(**inputs, **options)
    kept = ~near_cutoff(info, relative=1e-4)[..., None]
    assert kept.double().mean() > 0.8

    def render(*tensors: torch.Tensor) -> torch.Tensor:
        changed = dict(zip(names, tensors, strict=True))
        image, alpha, _ = rasterization_reference(**{**inputs, **changed}, **options)
        return torch.cat([image, alpha], dim=-1) * kept

    assert torch.autograd.gradcheck(render, [inputs[n] for n in names], eps=STEP, fast_mode=True)


def test_boxes_hold_every_pixel_above_the_threshold(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reference skips Gaussians whose boxes do not reach a square. Blending all of them gives the same image."""
    monkeypatch.setattr(torch_reference, "SQUARE", 4)  # small squares, many boxes left out
    scene = leaves(random_scene(cameras=2, sh_degree=1), torch.float64)
    image, alpha, _ = rasterization_reference(**scene)
    monkeypatch.setattr(
        torch_reference, "_reaches", lambda projected, _: torch.ones_like(projected.depths, dtype=torch.bool)
    )
    everywhere, alpha_everywhere, _ = rasterization_reference(**scene)
    torch.testing.assert_close(everywhere, image, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(alpha_everywhere, alpha, rtol=1e-12, atol=1e-13)


def test_absgrad_is_the_sum_of_the_absolute_gradients_of_single_pixels() -> None:
    scene = random_scene(n=12, width=4, height=3, cameras=2, seed=5)
    inputs = leaves(scene, torch.float64)
    image, _, info = rasterization_reference(**inputs, absgrad=True)
    total = torch.zeros_like(info["means2d"])
    for value in image.sum(dim=-1).flatten():
        total += torch.autograd.grad(value, info["means2d"], retain_graph=True)[0].abs()
    info["means2d"].absgrad.zero_()
    image.sum().backward()
    torch.testing.assert_close(info["means2d"].absgrad, total)
    assert total.any()
