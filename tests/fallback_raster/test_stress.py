"""Extreme but finite inputs give finite images and gradients, and nothing crashes.

The default run is a sample. The long run is
`pytest tests/fallback_raster/test_stress.py --stress-examples 10000`.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from raster_scenes import DIFFERENTIABLE, random_scene, relative_error
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.oracle.torch_reference import near_cutoff, rasterization_reference

SCALES = ("usual", "1e-12", "1e6", "zero", "any magnitude", "needles", "disks")
QUATS = ("usual", "zero", "1e18", "1e-18", "one axis")
OPACITIES = ("usual", "0", "1", "at the threshold", "1e-30")
PLACES = (
    "usual",
    "one point",
    "one depth",
    "camera plane",
    "camera",
    "behind",
    "near plane",
    "off screen",
    "1e6",
)
COLORS = ("usual", "negative", "1e4", "zero")
FOCALS = (1e-4, 0.5, 20.0, 1e4, 1e8)
CENTERS = (0.5, 0.0, 1.3, -40.0, 1e5)
SIZES = ((1, 1), (1, 9), (17, 1), (16, 16), (33, 15), (5, 50))


def magnitudes(generator: torch.Generator, low: float, high: float, *shape: int) -> Tensor:
    return 10.0 ** (low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64))


def extreme_scene(draw: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of `rasterization` for one drawn combination of extremes."""
    n, cameras, (width, height) = draw["n"], draw["cameras"], draw["size"]
    generator = torch.Generator().manual_seed(draw["seed"])

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = normal(n, 3) + torch.tensor([0.0, 0.0, 4.0])
    column = torch.zeros(n, 1, dtype=torch.float64)
    means = {
        "usual": means,
        "one point": torch.tensor([[0.1, -0.2, 3.0]]).expand(n, 3),
        "one depth": torch.cat([means[:, :2], column + 3.0], dim=1),
        "camera plane": torch.cat([means[:, :2], column], dim=1),
        "camera": means * 0,
        "behind": -means,
        "near plane": torch.cat([means[:, :2] * 1e-2, column + 0.01], dim=1),
        "off screen": torch.cat([means[:, :2] * 1e4, column + 2.0], dim=1),
        "1e6": means * 1e6,
    }[draw["place"]]
    scales = {
        "usual": magnitudes(generator, -2, 0, n, 3),
        "1e-12": torch.full((n, 3), 1e-12),
        "1e6": torch.full((n, 3), 1e6),
        "zero": torch.zeros(n, 3),
        "any magnitude": magnitudes(generator, -12, 6, n, 3),
        "needles": torch.tensor([[1e-9, 1e-7, 1e3]]).expand(n, 3),
        "disks": torch.tensor([[1e-9, 2.0, 2.0]]).expand(n, 3),
    }[draw["scale"]]
    quats = {
        "usual": normal(n, 4),
        "zero": torch.zeros(n, 4),
        "1e18": normal(n, 4) * 1e18,
        "1e-18": normal(n, 4) * 1e-18,
        "one axis": torch.tensor([[0.0, 0.0, -2.0, 0.0]]).expand(n, 4),
    }[draw["quat"]]
    opacities = {
        "usual": uniform(n),
        "0": torch.zeros(n),
        "1": torch.ones(n),
        "at the threshold": torch.full((n,), 1 / 255) * (1 + 1e-6 * normal(n)),
        "1e-30": torch.full((n,), 1e-30),
    }[draw["opacity"]]
    colors = uniform(n, 3) if draw["sh_degree"] is None else normal(n, (draw["sh_degree"] + 1) ** 2, 3)
    colors = colors * {"usual": 1.0, "negative": -1.0, "1e4": 1e4, "zero": 0.0}[draw["color"]]
    viewmats = torch.eye(4).repeat(cameras, 1, 1)
    viewmats[:, 0, 3] += 0.3 * torch.arange(cameras)
    Ks = torch.eye(3).repeat(cameras, 1, 1)
    Ks[:, 0, 0], Ks[:, 1, 1] = draw["focal"] * width, draw["focal"] * height * draw["aspect"]
    Ks[:, 0, 2], Ks[:, 1, 2] = draw["center"] * width, (1.0 - draw["center"]) * height
    scene: dict[str, Any] = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
        "backgrounds": uniform(cameras, 3) if draw["background"] else None,
    }
    for name, value in scene.items():
        if value is not None:
            value = strided(value.to(draw["dtype"])) if draw["strided"] else value.to(draw["dtype"]).clone()
            scene[name] = value.detach().requires_grad_(name in DIFFERENTIABLE)
    scene.update(width=width, height=height, sh_degree=draw["sh_degree"], **draw["options"])
    return scene


def strided(value: Tensor) -> Tensor:
    """Return the same values with gaps in memory and all dimensions in reverse order."""
    backwards = tuple(reversed(range(value.dim())))
    gaps = value.new_full((*value.shape[::-1], 2), float("nan"))
    gaps[..., 0] = value.permute(backwards)
    return gaps[..., 0].permute(backwards)


def check_finite(scene: dict[str, Any]) -> None:
    """Render, run the backward pass, and check every number of the results."""
    image, alpha, info = rasterization(**scene)
    cameras = scene["viewmats"].shape[0]
    assert image.shape[:3] == (cameras, scene["height"], scene["width"])
    assert alpha.shape == (cameras, scene["height"], scene["width"], 1)
    assert image.isfinite().all(), "image"
    assert ((alpha >= 0) & (alpha <= 1)).all(), "alpha"
    assert (info["radii"] >= 0).all()
    info["means2d"].retain_grad()
    (image.sum() + alpha.sum()).backward()
    assert info["means2d"].isfinite().all(), "means2d"
    assert info["means2d"].grad.isfinite().all(), "gradient of means2d"
    for name in DIFFERENTIABLE:
        if scene[name] is not None:
            gradient = scene[name].grad
            if name in ("colors", "backgrounds") and "RGB" not in scene.get("render_mode", "RGB"):
                assert gradient is None or not gradient.any(), name
                continue
            assert gradient is not None, f"no gradient for {name}"
            assert gradient.shape == scene[name].shape and gradient.dtype == scene[name].dtype, name
            assert gradient.isfinite().all(), f"gradient of {name}"


DRAWS: dict[str, Any] = {
    "n": st.sampled_from([0, 1, 2, 3, 17, 70]),
    "cameras": st.sampled_from([1, 2]),
    "size": st.sampled_from(SIZES),
    "seed": st.integers(0, 2**31),
    "place": st.sampled_from(PLACES),
    "scale": st.sampled_from(SCALES),
    "quat": st.sampled_from(QUATS),
    "opacity": st.sampled_from(OPACITIES),
    "color": st.sampled_from(COLORS),
    "focal": st.sampled_from(FOCALS),
    "aspect": st.sampled_from([1.0, 1e-3, 30.0]),
    "center": st.sampled_from(CENTERS),
    "sh_degree": st.sampled_from([None, 0, 1, 2, 3]),
    "background": st.booleans(),
    "strided": st.booleans(),
    "dtype": st.sampled_from([torch.float32, torch.float64]),
    "options": st.fixed_dictionaries(
        {
            "render_mode": st.sampled_from(["RGB", "D", "ED", "RGB+D", "RGB+ED"]),
            "rasterize_mode": st.sampled_from(["classic", "antialiased"]),
            "packed": st.booleans(),
            "absgrad": st.booleans(),
            "eps2d": st.sampled_from([0.3, 0.0, 1e-6]),
            "radius_clip": st.sampled_from([0.0, 2.0]),
            "near_plane": st.sampled_from([0.01, 1e-5]),
        }
    ),
}


def test_generated_extremes(stress_examples: int) -> None:
    @settings(
        max_examples=stress_examples,
        deadline=None,
        derandomize=True,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(draw=st.fixed_dictionaries(DRAWS))
    def check(draw: dict[str, Any]) -> None:
        check_finite(extreme_scene(draw))

    check()


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(
    draw=st.fixed_dictionaries(
        {
            **DRAWS,
            "place": st.sampled_from([place for place in PLACES if place != "near plane"]),
            "scale": st.sampled_from(["usual", "1e-12", "zero", "disks", "1e6"]),
            "focal": st.sampled_from([0.5, 20.0]),
            "center": st.sampled_from([0.5, 0.0, 1.3]),
            "sh_degree": st.none(),
            "options": st.fixed_dictionaries(
                {"rasterize_mode": st.sampled_from(["classic", "antialiased"]), "packed": st.booleans()}
            ),
        }
    )
)
def test_extremes_within_the_reach_of_float32_are_right(draw: dict[str, Any]) -> None:
    scene = extreme_scene({**draw, "dtype": torch.float32})
    exact = {name: t.detach().double() if torch.is_tensor(t) else t for name, t in scene.items()}
    image, alpha, _ = rasterization(**scene)
    truth, alpha_truth, info = rasterization_reference(**exact)
    kept = ~near_cutoff(info, relative=1e-2)[..., None]
    assert ((alpha - alpha_truth).abs() * kept).max() < 1e-3
    assert ((image - truth).abs() * kept).max() < 1e-3 * max(1.0, truth.abs().max().item())


USUAL: dict[str, Any] = {
    "n": 20,
    "cameras": 1,
    "size": (33, 15),
    "seed": 1,
    "place": "usual",
    "scale": "usual",
    "quat": "usual",
    "opacity": "usual",
    "color": "usual",
    "focal": 0.5,
    "aspect": 1.0,
    "center": 0.5,
    "sh_degree": 3,
    "background": True,
    "strided": False,
    "dtype": torch.float32,
    "options": {"render_mode": "RGB+ED", "rasterize_mode": "antialiased"},
}
FIXED: list[dict[str, Any]] = [
    {},
    {"n": 0},
    {"n": 1},
    *({"scale": scale} for scale in SCALES),
    *({"quat": quat} for quat in QUATS),
    *({"opacity": opacity} for opacity in OPACITIES),
    *({"place": place} for place in PLACES),
    *({"place": place, "scale": "1e6"} for place in PLACES),
    *({"color": color} for color in COLORS),
    *({"size": size} for size in SIZES),
    *({"focal": focal, "scale": "any magnitude"} for focal in FOCALS),
    *({"center": center} for center in CENTERS),
    {"dtype": torch.float64},
    {"strided": True},
    {"scale": "needles", "options": {"eps2d": 0.0}},
    {"scale": "zero", "options": {"eps2d": 0.0, "rasterize_mode": "antialiased"}},
    {"place": "camera plane", "options": {"near_plane": 0.0}},
    {"place": "camera plane", "options": {"near_plane": -1.0}},
    {"place": "one point", "opacity": "1", "n": 70},
]


@pytest.mark.parametrize("case", FIXED, ids=str)
def test_fixed_extremes(case: dict[str, Any]) -> None:
    check_finite(extreme_scene({**USUAL, **case}))


@pytest.mark.parametrize("how", ["strided", "float64", "expanded"])
def test_layout_and_dtype_change_nothing(how: str) -> None:
    plain = {**USUAL, "n": 40, "strided": False}
    scenes = [extreme_scene(plain), extreme_scene(plain)]
    for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds"):
        value = scenes[1][name].detach()
        if how == "strided":
            value = strided(value)
        elif how == "float64":
            value = value.double()
        elif name == "quats":
            value = value[:1].expand(40, 4)
            scenes[0][name] = value.clone().requires_grad_()
        scenes[1][name] = value.requires_grad_(name in DIFFERENTIABLE)
    results = []
    for scene in scenes:
        image, alpha, _ = rasterization(**scene)
        (image.sum() + alpha.sum()).backward()
        results.append([image, alpha, *(scene[name].grad for name in DIFFERENTIABLE)])
    for first, second in zip(*results, strict=True):
        assert relative_error(second, first) < 1e-6


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "value"),
    [(name, NAN) for name in ("means", "quats", "scales", "opacities", "colors")]
    + [(name, value) for name in ("means", "quats", "colors") for value in (INF, -INF)],
)
def test_a_poisoned_gaussian_is_refused_or_stays_where_it_is(name: str, value: float) -> None:
    scene = random_scene(n=50)
    scene["means"][0], scene["scales"][0], scene["opacities"][0] = 0.0, 0.1, 0.9  # in the middle of the image
    without = {k: v[1:] if torch.is_tensor(v) and len(v) == 50 else v for k, v in scene.items()}
    clean, _, _ = rasterization_reference(**scene)
    others, _, _ = rasterization_reference(**without)
    untouched = (clean == others).all(dim=-1)
    assert untouched.any() and not untouched.all()
    poisoned = {**scene, name: scene[name].clone()}
    poisoned[name][(0, 1)[: poisoned[name].dim()]] = value
    try:
        image, _, _ = rasterization(**poisoned)
    except ValueError as error:
        assert name in str(error)
    else:
        torch.testing.assert_close(image[untouched], others[untouched], rtol=0, atol=1e-5)


@pytest.mark.parametrize("value", [INF, NAN])
def test_a_poisoned_colour_leaves_the_gradients_of_a_neighbour_alone(value: float) -> None:
    """Two faint dots three pixels apart, in the same few pixels that the kernels handle at once."""
    centres = torch.tensor([[0.5, 0.5], [3.5, 3.5]])
    scene = {
        "means": torch.cat([(centres - 4.0) / 100.0, torch.ones(2, 1)], 1),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(2, 1),
        "scales": torch.full((2, 3), 1e-4),
        "opacities": torch.full((2,), 0.02),
        "colors": torch.tensor([[value, 0.5, 0.5], [0.2, 0.5, 0.8]]),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[100.0, 0.0, 4.0], [0.0, 100.0, 4.0], [0.0, 0.0, 1.0]]]),
    }
    inputs = {name: t.requires_grad_(name in DIFFERENTIABLE) for name, t in scene.items()}
    image, _, _ = rasterization(**inputs, width=8, height=8, packed=False)
    assert not image[0, 0, 0].isfinite().all() and image[0, 2:, 2:].isfinite().all()
    image.sum().backward()
    for name in ("means", "scales", "opacities", "colors"):
        assert inputs[name].grad[1].isfinite().all()
    assert inputs["colors"].grad[1].any()


@pytest.mark.parametrize("name", ["scales", "opacities", "viewmats", "Ks", "backgrounds"])
@pytest.mark.parametrize("value", [INF, NAN])
def test_a_poison_that_reaches_every_pixel_does_not_crash(name: str, value: float) -> None:
    scene = random_scene(n=50, backgrounds=True)
    scene[name] = scene[name].clone()
    scene[name].view(-1)[0] = value
    try:
        image, _, _ = rasterization(**scene)
    except ValueError as error:
        assert name in str(error)
    else:
        assert image.shape == (1, scene["height"], scene["width"], 3)
