"""First lists may end at any depth: the image equals that of whole lists to the bit."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from raster_scenes import deep_scene, leaves, relative_error
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization, set_num_threads
from skipgs_plug.fallback_raster.runtime.constants import NO_DEPTH, tiles
from skipgs_plug.fallback_raster.runtime.optimizations import without_optimizations
from skipgs_plug.fallback_raster.runtime.threads import get_num_threads
from skipgs_plug.fallback_raster.splats import rasterize_splats
from skipgs_plug.fallback_raster.stages import binning, compose, two_pass


def rendered(scene: dict[str, Any], **options: Any) -> tuple[list[Tensor], list[Tensor]]:
    """Return the results that must be equal, and gradients."""
    inputs = leaves(scene, torch.float32, ("viewmats",))
    image, alpha, info = rasterization(**inputs, **options)
    weights = torch.rand(image.shape, generator=torch.Generator().manual_seed(1))
    ((image * weights).sum() + (alpha * alpha).sum()).backward()
    found = [image.detach(), alpha.detach(), info["tiles_per_gauss"]]
    gradients = [t.grad for t in inputs.values() if torch.is_tensor(t) and t.grad is not None]
    if options.get("absgrad"):
        gradients.append(info["means2d"].absgrad)
    return found, gradients


def assert_same(one: tuple[list[Tensor], list[Tensor]], other: tuple[list[Tensor], list[Tensor]]) -> None:
    for value, truth in zip(one[0], other[0], strict=True):
        assert torch.equal(value, truth)
    # The pairs of a row are added in another order, so gradients round differently.
    for value, truth in zip(one[1], other[1], strict=True):
        assert relative_error(value, truth) < 2e-6


def ending_at(monkeypatch: pytest.MonkeyPatch, depths: Any) -> list[int]:
    """Let first lists end at `depths(tiles)`. Returns a list to which the lengths of second lists are appended."""
    lists: list[int] = []

    def ranges(visible: Tensor, splats: Any, *size: int) -> Tensor:
        tiles_x, tiles_y = tiles(*size)
        ends = depths(tiles_x * tiles_y).to(torch.float32).contiguous()
        return torch.stack([torch.full_like(ends, -1e30).view(torch.int32), ends.view(torch.int32)], dim=1)

    def bin_behind(*args: Any) -> Any:
        found = two_pass.bin_behind(*args)
        lists.append(0 if found is None else len(found[0].tile_record))
        return found

    monkeypatch.setattr(compose, "near_ranges", ranges)
    monkeypatch.setattr(compose, "bin_behind", bin_behind)
    return lists


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"packed": False, "absgrad": True},
        {"rasterize_mode": "antialiased"},
        {"render_mode": "RGB+ED"},
        {"render_mode": "D"},
    ],
    ids=lambda options: "-".join(map(str, options.values())) or "default",
)
@pytest.mark.parametrize("seed", [0, 1])
def test_any_end_of_the_first_lists_gives_the_same_image(
    monkeypatch: pytest.MonkeyPatch, options: dict[str, Any], seed: int
) -> None:
    scene = deep_scene(2000, seed=seed)
    with without_optimizations("two_pass"):
        whole = rendered(scene, **options)
    generator = torch.Generator().manual_seed(seed)
    lists = ending_at(monkeypatch, lambda count: 1.5 + 7 * torch.rand(count, generator=generator))
    assert_same(rendered(scene, **options), whole)
    assert lists[0] > 0  # some tiles needed the second pass


def test_what_only_just_reaches_an_open_tile_is_listed_there(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    scene = deep_scene(600)
    # The Gaussians are as wide as tiles, and so faint that no pixel is finished.
    scene["scales"] = 0.1 + 0.4 * torch.rand(600, 3, generator=generator)
    scene["opacities"] = 0.02 + 0.08 * torch.rand(600, generator=generator)
    with without_optimizations("two_pass"):
        whole = rendered(scene)
    # First lists are empty in the tiles of one column, and complete in all others, which are not open then.
    everything = torch.tensor(NO_DEPTH, dtype=torch.int32).view(torch.float32)
    lists = ending_at(monkeypatch, lambda count: torch.where(torch.arange(count) % 5 == 1, 0.5, everything))
    assert_same(rendered(scene), whole)
    assert lists[0] > 100


@pytest.mark.parametrize("end", [0.5, 100.0], ids=["nothing at first", "everything at first"])
def test_first_lists_that_hold_nothing_or_everything(monkeypatch: pytest.MonkeyPatch, end: float) -> None:
    scene = deep_scene(1000)
    with without_optimizations("two_pass"):
        whole = rendered(scene)
    lists = ending_at(monkeypatch, lambda count: torch.full((count,), end))
    assert_same(rendered(scene), whole)
    assert (lists[0] > 0) == (end < 1)


def test_deep_scenes_are_listed_in_part(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = deep_scene(6000, size=4.0)
    listed = []

    def bin_gaussians(*args: Any) -> Any:
        listed.append(original(*args))
        return listed[-1]

    original = compose.bin_gaussians
    monkeypatch.setattr(compose, "bin_gaussians", bin_gaussians)
    part = rendered(scene)
    with without_optimizations("two_pass"):
        whole = rendered(scene)
    assert_same(part, whole)
    near, everything = (len(bins.tile_record) for bins in listed)
    assert near < 0.8 * everything


def test_equal_depths_on_either_side_of_the_end_stay_together(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = deep_scene(1500)
    scene["means"][:, 2] = scene["means"][:, 2].round()
    with without_optimizations("two_pass"):
        whole = rendered(scene)
    ending_at(monkeypatch, lambda count: torch.full((count,), 4.0))
    assert_same(rendered(scene), whole)


def test_both_lists_together_are_no_longer_than_their_places_can_count(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = deep_scene(2000)
    listed: list[int] = []

    def bin_gaussians(*args: Any) -> Any:
        bins = binning.bin_gaussians(*args)
        listed.append(len(bins.tile_record))
        return bins

    monkeypatch.setattr(compose, "bin_gaussians", bin_gaussians)
    lists = ending_at(monkeypatch, lambda count: torch.full((count,), 3.0))
    rendered(scene)
    monkeypatch.setattr(binning, "MAX_PAIRS", listed[0] + lists[0])
    rendered(scene)
    monkeypatch.setattr(binning, "MAX_PAIRS", listed[0] + lists[0] - 1)
    with pytest.raises(ValueError, match=f"cover {listed[0] + lists[0]:,} tiles"):
        rendered(scene)


def test_any_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = deep_scene(3000)
    ending_at(monkeypatch, lambda count: 2.5 + 3 * torch.linspace(0, 1, count))
    before, found = get_num_threads(), []
    try:
        for count in (1, 2, 5):
            set_num_threads(count)
            found.append(rendered(scene))
    finally:
        set_num_threads(before)
    for other in found[1:]:
        for one, two in zip(found[0][0] + found[0][1], other[0] + other[1], strict=True):
            assert torch.equal(one, two)


def test_raw_parameters(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = deep_scene(2000)

    def gradients() -> tuple[list[Tensor], list[Tensor]]:
        raw = [scene["means"], scene["quats"], scene["scales"].log(), scene["opacities"].clamp(max=0.99).logit()]
        raw += [scene["colors"][:, None], torch.zeros(2000, 15, 3)]
        raw = [t.clone().requires_grad_() for t in raw]
        camera = scene["viewmats"][0], scene["Ks"][0], scene["width"], scene["height"], 3
        image, transmittance, info = rasterize_splats(*raw, *camera, absgrad=True)
        (image.square().sum() - transmittance.sum()).backward()
        of_centres = [info["means2d"].grad, info["means2d"].absgrad]
        return [image.detach(), transmittance.detach()], [t.grad for t in raw if t.grad is not None] + of_centres

    with without_optimizations("two_pass"):
        whole = gradients()
    lists = ending_at(monkeypatch, lambda count: torch.full((count,), 3.0))
    assert_same(gradients(), whole)
    assert lists[0] > 0
