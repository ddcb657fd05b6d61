"""The float32 rasterizer against the float64 reference: image and every gradient, in every mode."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import errors_against_reference, leaves, random_scene, relative_error

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.oracle.torch_reference import rasterization_reference
from skipgs_plug.fallback_raster.runtime.optimizations import OPTIMIZATIONS, without_optimizations

IMAGE_ERROR = 1e-5
GRADIENT_ERROR = 1e-4

CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    **{f"SH {degree}": ({"sh_degree": degree}, {}) for degree in range(4)},
    **{f"{channels} features": ({"channels": channels}, {}) for channels in (1, 2, 3, 4, 5, 8)},
    **{mode: ({}, {"render_mode": mode}) for mode in ("D", "ED", "RGB+D", "RGB+ED")},
    "antialiased": ({}, {"rasterize_mode": "antialiased"}),
    "antialiased, SH 3": ({"sh_degree": 3}, {"rasterize_mode": "antialiased"}),
    "background": ({"backgrounds": True}, {}),
    "background, depth": ({"backgrounds": True, "sh_degree": 2}, {"render_mode": "RGB+ED"}),
    "three cameras": ({"cameras": 3, "sh_degree": 1, "backgrounds": True}, {}),
    "packed": ({"cameras": 3, "sh_degree": 1}, {"packed": True}),
    "packed, plain colors": ({"cameras": 2}, {"packed": True, "render_mode": "RGB+D"}),
    "packed, 5 features": ({"channels": 5}, {"packed": True}),
    "packed, depth alone": ({}, {"packed": True, "render_mode": "ED"}),
    "packed, antialiased": ({"cameras": 2}, {"packed": True, "rasterize_mode": "antialiased"}),
    "absgrad": ({}, {"absgrad": True}),
    "absgrad, packed": ({"cameras": 3}, {"absgrad": True, "packed": True}),
    "near and far": ({}, {"near_plane": 3.5, "far_plane": 5.0}),
    "radius clip": ({}, {"radius_clip": 3.0}),
    "no blur": ({}, {"eps2d": 1e-3}),
    "much blur": ({}, {"eps2d": 4.0, "rasterize_mode": "antialiased"}),
    "tiles of 8": ({}, {"tile_size": 8}),
    "large tiles": ({}, {"tile_size": 32}),
    "odd size": ({"width": 17, "height": 53}, {}),
    "one pixel": ({"width": 1, "height": 1, "n": 60}, {}),
    "many Gaussians": ({"n": 2000, "width": 64, "height": 48, "sh_degree": 3}, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_image_and_gradients(case: str) -> None:
    scene, options = CASES[case]
    errors = errors_against_reference(rasterization, random_scene(**scene), **{"packed": False, **options})
    wrong = {
        name: error
        for name, error in errors.items()
        if not error < (IMAGE_ERROR if name in ("image", "alpha") else GRADIENT_ERROR)
    }
    assert not wrong, errors


@pytest.mark.parametrize("case", ["SH 3", "background, depth", "absgrad, packed", "5 features", "many Gaussians"])
def test_optimizations_change_nothing(case: str) -> None:
    """Without optimizations the rasterizer is a second oracle: it drops only alphas below the threshold."""
    scene, options = CASES[case]
    results = []
    for left_out in ((), tuple(OPTIMIZATIONS)):
        inputs = leaves(random_scene(**scene), torch.float32)
        with without_optimizations(*left_out):
            image, alpha, info = rasterization(**inputs, **{"packed": False, **options})
            generator = torch.Generator().manual_seed(1)
            upstream = torch.randn(image.shape, generator=generator)
            upstream[:, : image.shape[1] // 2] = 0.0  # lets optimizations of the adjoint leave out tiles
            torch.autograd.backward([image, alpha], [upstream, upstream[..., :1]])
        gradients = [t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None]
        results.append(([image.detach(), alpha.detach()], gradients, info["tiles_per_gauss"].sum()))
    (images, gradients, tiles), (plain_images, plain_gradients, plain_tiles) = results
    assert all(torch.equal(a, b) for a, b in zip(images, plain_images, strict=True))
    assert len(gradients) >= 5
    for fast, plain in zip(gradients, plain_gradients, strict=True):
        assert relative_error(fast, plain) < 1e-6
    assert tiles < plain_tiles  # exact_tiles left out some


def test_blocks_without_gradient_change_no_bit() -> None:
    """The sums of a pixel do not depend on the patches that are visited before."""
    scene = random_scene(n=3000, width=64, height=48)
    gradients = []
    for left_out in ((), ("zero_gradient",)):
        inputs = leaves(scene, torch.float32)
        with without_optimizations(*left_out):
            image, _, _ = rasterization(**inputs, packed=False)
            upstream = torch.randn(image.shape, generator=torch.Generator().manual_seed(1))
            upstream[:, : image.shape[1] // 2] = 0.0
            image.backward(upstream)
        gradients.append([t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None])
    assert len(gradients[0]) >= 5
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("case", ["SH 3", "antialiased", "RGB+ED", "three cameras", "packed", "near and far"])
def test_camera_gradients(case: str) -> None:
    scene, options = CASES[case]
    errors = errors_against_reference(
        rasterization, random_scene(**scene), extra=("viewmats",), **{"packed": False, **options}
    )
    assert errors["viewmats"] < GRADIENT_ERROR


def test_colors_and_harmonics_of_each_camera_on_their_own() -> None:
    for sh_degree in (None, 2):
        scene = random_scene(cameras=3, sh_degree=sh_degree)
        shades = torch.tensor([1.0, 0.5, 0.8]).reshape(3, *[1] * scene["colors"].dim())
        scene["colors"] = scene["colors"] * shades
        errors = errors_against_reference(rasterization, scene, packed=False)
        assert errors["image"] < IMAGE_ERROR
        assert errors["colors"] < GRADIENT_ERROR


def test_harmonics_above_the_used_degree_get_zero_gradient() -> None:
    scene = random_scene(sh_degree=3)
    scene["sh_degree"] = 1
    errors = errors_against_reference(rasterization, scene, packed=False)
    assert errors["image"] < IMAGE_ERROR
    assert errors["colors"] < GRADIENT_ERROR
    inputs = leaves(scene, torch.float32)
    rasterization(**inputs)[0].sum().backward()
    assert inputs["colors"].grad[:, :4].any()
    assert not inputs["colors"].grad[:, 4:].any()


def test_negative_harmonic_colors_are_clamped() -> None:
    scene = random_scene(sh_degree=1)
    scene["colors"] = scene["colors"] - 1.0
    errors = errors_against_reference(rasterization, scene, packed=False)
    assert max(errors.values()) < GRADIENT_ERROR


def test_opaque_pile_stops_where_the_reference_stops() -> None:
    scene = random_scene(n=400, seed=3)
    scene["means"] = scene["means"] * torch.tensor([0.3, 0.3, 1.0])
    scene["opacities"] = scene["opacities"].clamp(min=0.6)
    errors = errors_against_reference(rasterization, scene, packed=False)
    assert errors["image"] < IMAGE_ERROR
    assert max(errors.values()) < GRADIENT_ERROR


def test_saturated_alpha_passes_no_gradient() -> None:
    """alpha = min(0.999, opacity * falloff): where alpha is clamped, only the color has a gradient."""
    gradients = []
    for function, dtype in ((rasterization, torch.float32), (rasterization_reference, torch.float64)):
        scene = random_scene(n=1, width=9, height=9)
        scene["means"] = torch.zeros(1, 3)
        scene["scales"] = torch.full((1, 3), 10.0)
        scene["opacities"] = torch.ones(1)
        inputs = leaves(scene, dtype)
        image, _, _ = function(**inputs)
        image[:, 4, 4].sum().backward()
        assert not inputs["opacities"].grad.any()
        assert not inputs["means"].grad.any()
        gradients.append(inputs["colors"].grad.double())
    torch.testing.assert_close(*gradients, rtol=1e-5, atol=0)


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("rasterize_mode", ["classic", "antialiased"])
def test_info_agrees(packed: bool, rasterize_mode: Any) -> None:
    scene = random_scene(cameras=3, sh_degree=1)
    options = {"packed": packed, "rasterize_mode": rasterize_mode}
    _, _, info = rasterization(**leaves(scene, torch.float32), **options)
    _, _, truth = rasterization_reference(**leaves(scene, torch.float64), **options)
    for name in ("width", "height", "tile_size", "tile_width", "tile_height", "n_cameras", "n_batches"):
        assert info[name] == truth[name], name
    assert torch.equal(info["radii"], truth["radii"])
    assert info["radii"].dtype == torch.int32
    for name in ("camera_ids", "gaussian_ids", "batch_ids"):
        assert torch.equal(info[name], truth[name]) if packed else info[name] is None, name
    seen = (truth["radii"] > 0).all(dim=-1)
    for name in ("means2d", "depths", "conics", "opacities"):
        assert info[name].shape == truth[name].shape, name
        torch.testing.assert_close(info[name][seen].double(), truth[name][seen], rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("channels", [3, 6])
def test_going_back_twice_adds_the_same_gradients_twice(channels: int) -> None:
    inputs = leaves(random_scene(channels=channels, backgrounds=True), torch.float32)
    image, _, info = rasterization(**inputs, absgrad=channels == 3)
    once: list[torch.Tensor] = []
    for _ in range(2):
        image.square().sum().backward(retain_graph=True)
        found = [t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None]
        found += [info["means2d"].absgrad] if channels == 3 else []
        once = once or [t.clone() for t in found]
    assert len(once) == (7 if channels == 3 else 6)
    assert all(torch.equal(t, 2 * first) for t, first in zip(found, once, strict=True))


def test_coincident_depths_keep_the_order_of_the_input() -> None:
    scene = random_scene(n=60)
    scene["means"] = scene["means"] * torch.tensor([1.0, 1.0, 0.0])
    scene["viewmats"] = torch.eye(4)[None]
    scene["viewmats"][0, 2, 3] = 4.0
    image, _, _ = rasterization(**leaves(scene, torch.float32))
    truth, _, _ = rasterization_reference(**leaves(scene, torch.float64))
    assert (image - truth).abs().max() < 1e-4
    reverse = {k: v.flip(0) if torch.is_tensor(v) and len(v) == 60 else v for k, v in scene.items()}
    assert (rasterization(**leaves(reverse, torch.float32))[0] - truth).abs().max() > 1e-2
