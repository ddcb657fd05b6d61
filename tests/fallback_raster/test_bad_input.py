"""Wrong or unsupported arguments raise one sentence that names them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from raster_scenes import random_scene

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.arguments import camera_centre

# One type serves most cases. NotImplementedError marks features that gsplat has and this rasterizer has not.
REFUSALS = (ValueError, TypeError, NotImplementedError)


def refuse(match: str, **changes: Any) -> None:
    with pytest.raises(REFUSALS, match=match) as caught:
        rasterization(**{**random_scene(n=7, cameras=2, sh_degree=1, backgrounds=True), **changes})
    assert "\n" not in str(caught.value)


WRONG_SHAPES = {
    "means": [(7, 4), (7,), (2, 7, 3)],
    "quats": [(7, 3), (6, 4)],
    "scales": [(7, 1), (8, 3)],
    "opacities": [(7, 1), (6,)],
    "colors": [(6, 4, 3), (7, 4, 4), (7, 3), (3, 7, 4, 3), (7, 3, 3)],
    "viewmats": [(4, 4), (2, 3, 4)],
    "Ks": [(3, 3), (1, 3, 3), (2, 4, 4)],
    "backgrounds": [(3,), (1, 3), (2, 4)],
}


@pytest.mark.parametrize(("name", "shape"), [(n, s) for n, shapes in WRONG_SHAPES.items() for s in shapes])
def test_shapes(name: str, shape: tuple[int, ...]) -> None:
    refuse(name, **{name: torch.ones(shape)})


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_integer_tensors(name: str) -> None:
    scene = random_scene(n=7, cameras=2, sh_degree=1, backgrounds=True)
    refuse(name, **{name: scene[name].to(torch.int64)})


@pytest.mark.parametrize("name", WRONG_SHAPES)
def test_tensors_of_another_device(name: str) -> None:
    scene = random_scene(n=7, cameras=2, sh_degree=1, backgrounds=True)
    refuse(name, **{name: scene[name].to("meta")})


@pytest.mark.parametrize("name", ["means", "viewmats"])
def test_arrays_that_are_no_tensors(name: str) -> None:
    scene = random_scene(n=7, cameras=2, sh_degree=1, backgrounds=True)
    refuse(name, **{name: scene[name].numpy()})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("width", 0),
        ("height", -3),
        ("sh_degree", 2),  # the colours have coefficients up to degree 1 only
        ("sh_degree", -1),
        ("render_mode", "depth"),
        ("rasterize_mode", "sharp"),
    ],
)
def test_values(name: str, value: Any) -> None:
    refuse(name, **{name: value})


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("sparse_grad", True),
        ("distributed", True),
        ("camera_model", "fisheye"),
        ("camera_model", "ortho"),
        ("camera_model", "ftheta"),
        ("with_ut", True),
        ("with_eval3d", True),
        ("covars", torch.eye(3).repeat(7, 1, 1)),
        ("radial_coeffs", torch.zeros(2, 4)),
        ("tangential_coeffs", torch.zeros(2, 2)),
        ("thin_prism_coeffs", torch.zeros(2, 4)),
        ("ftheta_coeffs", object()),
        ("viewmats_rs", torch.eye(4).repeat(2, 1, 1)),
    ],
)
def test_what_gsplat_can_and_this_cannot(name: str, value: Any) -> None:
    refuse(name, **{name: value})


def test_absolute_gradients_of_many_channels() -> None:
    scene = random_scene(n=7, cameras=2)
    for channels, mode in ((5, "RGB"), (4, "RGB+ED")):
        changes = {"colors": torch.ones(7, channels), "render_mode": mode, "absgrad": True}
        with pytest.raises(NotImplementedError, match="absgrad with at most 4 channels, depth included, got 5"):
            rasterization(**{**scene, **changes})
        rasterization(**{**scene, **changes, "absgrad": False})


def test_whole_numbers_where_gsplat_takes_them() -> None:
    scene = random_scene(n=7, cameras=2)
    expected, _, _ = rasterization(**scene, near_plane=1.0, far_plane=100.0, radius_clip=0.0, eps2d=1.0)
    image, _, _ = rasterization(**scene, near_plane=1, far_plane=100, radius_clip=0, eps2d=1)
    assert torch.equal(image, expected)


def test_rolling_shutter() -> None:
    gsplat: Any = pytest.importorskip("gsplat")
    refuse("rolling_shutter", rolling_shutter=gsplat.RollingShutterType.ROLLING_TOP_TO_BOTTOM)
    scene = random_scene(n=7, cameras=2)
    rasterization(**scene, rolling_shutter=gsplat.RollingShutterType.GLOBAL)  # its default


def test_whole_numbers_serve_where_gsplat_takes_them() -> None:
    scene = random_scene(n=7, cameras=1, sh_degree=1)
    plain = rasterization(**{**scene, "near_plane": 1.0, "far_plane": 100.0, "radius_clip": 0.0, "eps2d": 1.0})[0]
    whole = {"near_plane": 1, "far_plane": 100, "radius_clip": 0, "eps2d": 1}
    sizes = {name: np.int64(scene[name]) for name in ("width", "height")}
    assert torch.equal(plain, rasterization(**{**scene, **whole, **sizes})[0])


@pytest.mark.parametrize("degree", [1.0, "1", True])
def test_degrees_that_are_no_whole_number(degree: Any) -> None:
    refuse("sh_degree must be 0 to 3", sh_degree=degree)


@pytest.mark.parametrize("name", ["near_plane", "far_plane", "radius_clip", "eps2d"])
@pytest.mark.parametrize("value", ["1", None, float("nan")])
def test_distances_that_are_no_numbers(name: str, value: Any) -> None:
    refuse(f"{name} must be a number", **{name: value})


def test_a_camera_that_stands_nowhere() -> None:
    refuse("viewmats must be invertible, got .* for a camera", viewmats=torch.zeros(2, 4, 4))
    flat = torch.eye(4)
    flat[2, 2] = 0.0
    refuse("viewmats must be invertible, got .* for a camera", viewmats=flat.expand(2, 4, 4))


@pytest.mark.parametrize("last", [(0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 2.0), (0.1, 0.0, 0.2, 1.0)])
def test_where_any_camera_stands(last: tuple[float, ...]) -> None:
    for _ in range(50):
        viewmat = torch.randn(4, 4)
        viewmat[3] = torch.tensor(last)
        truth = torch.linalg.inv(viewmat.double())[:3, 3]
        error = (camera_centre(viewmat) - truth).abs().max()
        assert error <= 1e-5 * torch.linalg.cond(viewmat.double()) * truth.abs().max()


def test_a_single_camera_without_its_dimension() -> None:
    refuse(r"viewmats must have shape \[C, 4, 4\]", viewmats=torch.eye(4))
