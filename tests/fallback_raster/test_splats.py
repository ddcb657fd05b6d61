"""`rasterize_splats` of raw parameters equals `rasterization` of their activations in values, gradients and lists."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import random_scene, relative_error
from torch import Tensor

from skipgs_plug.fallback_raster import get_num_threads, rasterization, set_num_threads
from skipgs_plug.fallback_raster.splats import rasterize_splats
from skipgs_plug.fallback_raster.training.lazy_adam import LazyAdam

NAMES = ("means", "quats", "log_scales", "logits", "sh0", "shN")
OPTIONS: dict[str, dict[str, Any]] = {
    "plain": {},
    "antialiased": {"antialiased": True},
    "absgrad": {"absgrad": True},
    "background": {"background": torch.tensor([0.2, 0.9, 0.4])},
    "degree 1 of 3": {"sh_degree": 1},
}


def raw_scene(n: int = 700, **options: Any) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return raw parameters, the camera and the image size."""
    scene = random_scene(n=n, sh_degree=3, **options)
    raw = {
        "means": scene["means"],
        "quats": scene["quats"],
        "log_scales": scene["scales"].log(),
        "logits": scene["opacities"].logit(),
        "sh0": scene["colors"][:, :1].contiguous(),
        "shN": scene["colors"][:, 1:].contiguous(),
    }
    camera = {"viewmat": scene["viewmats"][0], "K": scene["Ks"][0], "width": scene["width"], "height": scene["height"]}
    return raw, camera


def activated(raw: dict[str, Tensor], camera: dict[str, Any], **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render the same image with the public function and torch's activations."""
    background = options.get("background")
    image, alpha, info = rasterization(
        raw["means"],
        raw["quats"],
        raw["log_scales"].exp(),
        raw["logits"].sigmoid(),
        (raw["sh0"], raw["shN"]),
        camera["viewmat"][None],
        camera["K"][None],
        camera["width"],
        camera["height"],
        near_plane=options.get("near_plane", 0.01),
        sh_degree=options.get("sh_degree", 3),
        packed=True,
        absgrad=options.get("absgrad", False),
        rasterize_mode="antialiased" if options.get("antialiased") else "classic",
        backgrounds=None if background is None else background[None],
    )
    return image[0], alpha[0], info


def results(function: Any, raw: dict[str, Tensor], camera: dict[str, Any], **options: Any) -> dict[str, Tensor]:
    leaves = {name: raw[name].clone().requires_grad_() for name in NAMES}
    image, alpha, info = function(leaves, camera, **options)
    info["means2d"].retain_grad()
    generator = torch.Generator().manual_seed(3)
    upstream = [torch.randn(t.shape, generator=generator) for t in (image, alpha)]
    torch.autograd.backward([image, alpha], upstream)
    found = {"image": image.detach(), "alpha": alpha.detach(), "means2d": info["means2d"].grad}
    found |= {name: leaf.grad for name, leaf in leaves.items()}
    found |= {name: info[name] for name in ("gaussian_ids", "radii")}
    return found | ({"absgrad": info["means2d"].absgrad} if options.get("absgrad") else {})


def splatted(raw: dict[str, Tensor], camera: dict[str, Any], **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    image, transmittance, info = rasterize_splats(
        *(raw[name] for name in NAMES), **camera, **{"sh_degree": 3, **options}
    )
    return image, (1.0 - transmittance)[..., None], info


@pytest.mark.parametrize("case", OPTIONS)
def test_raw_parameters_are_their_activations(case: str) -> None:
    raw, camera = raw_scene()
    truth = results(activated, raw, camera, **OPTIONS[case])
    fast = results(splatted, raw, camera, **OPTIONS[case])
    assert fast.keys() == truth.keys()
    for name, value in truth.items():
        assert fast[name].shape == value.shape
        if name in ("gaussian_ids", "radii"):
            assert torch.equal(fast[name], value)
        else:
            # An activation rounds once more or less, so a pixel at a cut-off may blend another Gaussian.
            assert relative_error(fast[name], value) < 2e-5, name


def test_activations_keep_their_digits_over_their_whole_range() -> None:
    """Scales from e^-16 to e^4 and opacities down to the threshold, one Gaussian each."""
    n = 2000
    raw, camera = raw_scene(n=n)
    raw["log_scales"] += torch.linspace(-12.0, 5.0, n)[:, None]
    raw["logits"] = torch.linspace(-5.5, 12.0, n)
    truth = results(activated, raw, camera)
    fast = results(splatted, raw, camera)
    assert torch.equal(fast["gaussian_ids"], truth["gaussian_ids"])
    for name in (*NAMES, "image"):
        assert relative_error(fast[name], truth[name]) < 2e-5, name


def test_any_number_of_threads_gives_the_same_bits() -> None:
    raw, camera = raw_scene(n=3000)
    before = get_num_threads()
    found = []
    for threads in (1, 2, 5):
        set_num_threads(threads)
        found.append(results(splatted, raw, camera, absgrad=True))
    set_num_threads(before)
    for other in found[1:]:
        for name, value in found[0].items():
            assert torch.equal(value, other[name]), name


def test_rows_without_a_pixel_have_zero_gradients() -> None:
    raw, camera = raw_scene()
    raw["means"][::2, 2] -= 100.0  # far behind the camera
    found = results(splatted, raw, camera)
    unseen = torch.ones(len(raw["means"]), dtype=torch.bool)
    unseen[found["gaussian_ids"]] = False
    assert unseen[::2].all() and not unseen.all()
    for name in NAMES:
        assert not found[name][unseen].any() and found[name][~unseen].any()


def test_without_gradients_the_centres_want_none() -> None:
    raw, camera = raw_scene()
    _, _, info = splatted(raw, camera)
    assert not info["means2d"].requires_grad


@pytest.mark.parametrize("absgrad", [False, True])
def test_rows_of_gaussians_can_be_left_out_of_the_dictionary(absgrad: bool) -> None:
    rows = {"camera_ids", "gaussian_ids", "radii", "means2d"}
    found = []
    for with_rows in (True, False):
        raw, camera = raw_scene()
        for tensor in raw.values():
            tensor.requires_grad_()
        image, _, info = splatted(raw, camera, absgrad=absgrad, with_rows=with_rows)
        image.square().sum().backward()
        assert rows & info.keys() == (rows if with_rows else set())
        found.append([image.detach(), *(tensor.grad for tensor in raw.values())])
    for whole, part in zip(*found, strict=True):
        assert part is not None and torch.allclose(whole, part, rtol=1e-5, atol=1e-7)
        assert absgrad or torch.equal(whole, part)


def test_a_parameter_that_grew_before_backward_is_an_error() -> None:
    raw, camera = raw_scene()
    leaf = raw["log_scales"].requires_grad_()
    image, _, _ = splatted(raw, camera)
    leaf.data = torch.cat([leaf.data, leaf.data])
    with pytest.raises(RuntimeError, match=r"^scales had shape"):
        image.sum().backward()


def test_a_wrong_shape_names_the_argument() -> None:
    raw, camera = raw_scene()
    raw["logits"] = raw["logits"][:-1]
    with pytest.raises(ValueError, match="opacities must have shape"):
        splatted(raw, camera)


def test_planes_may_be_whole_numbers_and_what_lies_behind_the_camera_is_never_drawn() -> None:
    raw, camera = raw_scene()
    expected, _, _ = splatted(raw, camera, near_plane=1.0, far_plane=50.0)
    assert torch.equal(splatted(raw, camera, near_plane=1, far_plane=50)[0], expected)
    with torch.no_grad():
        raw["means"][::2, 2] *= -1.0
    expected, _, _ = splatted(raw, camera, near_plane=0.0)
    for near in (-1.0, -100.0):
        assert torch.equal(splatted(raw, camera, near_plane=near)[0], expected)
        assert torch.equal(activated(raw, camera, near_plane=near)[0], activated(raw, camera, near_plane=0.0)[0])


class AskedFor(LazyAdam):
    """Records the rows that it was called with."""

    def __init__(self, params: Any) -> None:
        super().__init__(params)
        self.asked: list[Tensor] = []

    def catch_up(self, rows: Tensor | None = None) -> None:
        assert rows is not None
        self.asked.append(rows)


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("seen", [0.2, 0.9, 0.0])
def test_gradients_of_the_higher_bands_may_be_factors_of_visible_rows(seen: float, degree: int) -> None:
    raw, camera = raw_scene(n=1500)
    behind = torch.rand(1500, generator=torch.Generator().manual_seed(4)) >= seen
    raw["means"][behind, 2] -= 100.0
    dense = results(splatted, raw, camera, sh_degree=degree)
    optimizer = AskedFor([torch.nn.Parameter(raw["shN"].clone())])
    lazy = results(splatted, raw, camera, sh_degree=degree, lazy=optimizer)
    assert lazy.pop("shN") is None
    (param,) = optimizer.param_groups[0]["params"]
    assert torch.equal(param.grad.dense(), dense.pop("shN"))
    for name, value in dense.items():
        assert torch.equal(lazy[name], value), name
    visible = dense["gaussian_ids"]
    if degree == 0:
        assert not optimizer.asked and len(param.grad.factors.rows) == 0
    else:
        assert torch.equal(optimizer.asked[0].long(), visible) and len(optimizer.asked) == 1
        assert torch.equal(param.grad.factors.rows.long(), visible)
    once = param.grad.dense()
    results(splatted, raw, camera, sh_degree=degree, lazy=optimizer)
    assert torch.equal(param.grad, 2 * once)


def test_higher_bands_that_are_brought_up_to_date_are_rendered() -> None:
    raw, camera = raw_scene()
    late = {**raw, "shN": raw["shN"].clone()}

    class Late(LazyAdam):
        def catch_up(self, rows: Tensor | None = None) -> None:
            assert rows is not None
            late["shN"][rows.long()] = raw["shN"][rows.long()]

    late["shN"].zero_()
    lazy = Late([torch.nn.Parameter(late["shN"])])
    assert torch.equal(splatted(late, camera, lazy=lazy)[0], splatted(raw, camera)[0])
    assert bool(late["shN"].any())
