"""Gaussians nearer to a camera than anything that its view shows are pruned while the scene grows."""

from __future__ import annotations

import math

import pytest
import torch

from skipgs_plug.commands.options import bench, train
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, clear_views
from skipgs_plug.trainer.clear_views import FADED, ClearViews
from skipgs_plug.trainer.near_plane import nearest_depths
from skipgs_plug.trainer.scene import View


@pytest.fixture
def two() -> Scene:
    """Cameras at x = 1 and x = -1 look along +z at a wall of points at a depth of 4."""
    points = torch.rand(500, 3) * torch.tensor([4.0, 2.0, 0.0]) + torch.tensor([-2.0, -1.0, 4.0])
    K = torch.tensor([[32.0, 0, 16], [0, 32.0, 16], [0, 0, 1]])
    views = []
    for x in (1.0, -1.0):
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[0, 3] = -x
        views.append(View(f"{x}.png", torch.zeros(32, 32, 3, dtype=torch.uint8), K, viewmat))
    return Scene("two", views, [], points, torch.zeros(500, 3, dtype=torch.uint8), 1.1)


PLACES = {
    "near the first camera": [1.0, 0.0, 0.5],
    "a little nearer than half of the depth": [-1.0, 0.0, 1.98],
    "a little farther": [-1.0, 0.0, 2.02],
    "beside its picture": [2.0, 0.0, 0.5],
    "behind it": [1.0, 0.0, -0.98],
    "farther behind": [1.0, 0.0, -1.02],
    "at the wall": [0.0, 0.0, 4.0],
}


def faded(scene: Scene, share: float) -> list[str]:
    opacities = torch.zeros(len(PLACES))
    clear = ClearViews(scene.train, nearest_depths(scene.train, scene.points), share)
    clear.fade(torch.tensor(list(PLACES.values())), opacities)
    assert opacities.unique().tolist() in ([FADED, 0.0], [0.0])
    return [place for place, opacity in zip(PLACES, opacities, strict=True) if opacity]


def test_what_is_nearer_than_half_of_the_nearest_points_or_around_a_camera_is_faded(two: Scene) -> None:
    assert faded(two, 0.5) == ["near the first camera", "a little nearer than half of the depth", "behind it"]
    assert faded(two, 0.511) == [*list(PLACES)[:3], "behind it", "farther behind"]
    assert faded(two, 0.0) == []


def test_a_view_without_points_has_no_limit(two: Scene) -> None:
    two.train[0].viewmat[2, 2] = two.train[0].viewmat[0, 0] = -1.0  # it looks away
    assert nearest_depths(two.train, two.points)[0] is None
    assert faded(two, 0.5) == ["a little nearer than half of the depth"]


def test_many_views_correct_each_other(two: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clear_views, "FEW", 1)
    assert faded(two, 0.5) == []


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
@pytest.mark.parametrize("share", [0.5, 0.0])
def test_densification_removes_it(tiny_scene: Scene, strategy: str, share: float) -> None:
    config = TrainConfig(max_steps=60, refine_every=4, strategy=strategy, clear_depth=share)
    trainer = Trainer(config, tiny_scene)
    view = tiny_scene.train[0]
    camera = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
    limit = nearest_depths(tiny_scene.train, tiny_scene.points)[0]
    assert limit is not None
    trainer.train(until=3, progress=False)
    place = (camera + 0.4 * limit * view.viewmat[2, :3]).float()
    with torch.no_grad():
        trainer.splats["means"][:3] = place
        trainer.splats["opacities"][:3] = 2.0
    trainer.train(until=5, progress=False)
    assert bool(((trainer.splats["means"] - place).norm(dim=1) < 0.1 * limit).any()) == (share == 0.0)


def test_a_bench_follows_the_plain_recipe() -> None:
    assert bench.parse(["scene"]).train.clear_depth == 0.0
    assert train.parse(["scene", "--out", "run"]).train.clear_depth == 0.5


def test_the_opacity_is_below_any_that_is_drawn() -> None:
    assert 1.0 / (1.0 + math.exp(-FADED)) < 1.0 / 255.0
