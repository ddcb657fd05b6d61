"""The near plane follows the scene in any unit."""

import pytest
import torch

from skipgs_plug.trainer import InputError, TrainConfig, Trainer
from skipgs_plug.trainer.near_plane import NEAREST, SHARE, SHARE_OF_EXTENT, before_a_lens, near_plane, nearest_depths
from skipgs_plug.trainer.scene import Scene, View


def scene(unit: float = 1.0, depth: float = 4.0, n_points: int = 1000, seed: int = 0) -> Scene:
    """Two cameras look along +z at points between `depth` and twice that."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n_points, 3, generator=generator) - 0.5
    points[:, 2] = depth * (points[:, 2] + 1.5)
    K = torch.tensor([[50.0, 0, 16], [0, 50.0, 16], [0, 0, 1]])
    views = []
    for i, x in enumerate((-0.5, 0.5)):
        viewmat = torch.eye(4)
        viewmat[0, 3] = x * unit
        views.append(View(f"{i}.png", torch.zeros(32, 32, 3, dtype=torch.uint8), K, viewmat))
    return Scene("two", views, [], points * unit, torch.zeros(n_points, 3, dtype=torch.uint8), 0.55 * unit)


def test_a_tenth_of_the_nearest_depth() -> None:
    assert near_plane(TrainConfig(), scene()) == pytest.approx(SHARE * 4.0, rel=0.05)


@pytest.mark.parametrize("unit", [1e-3, 7.0, 1e4])
def test_scales_with_the_unit_of_the_scene(unit: float) -> None:
    assert near_plane(TrainConfig(), scene(unit)) == pytest.approx(unit * near_plane(TrainConfig(), scene()), rel=1e-4)


def test_a_few_points_at_the_lens_do_not_count_but_a_close_view_does() -> None:
    usual, _ = nearest_depths(scene().train, scene().points)
    stray = scene()
    stray.points[: int(NEAREST * 1000) // 2] = torch.tensor([0.0, 0.0, 0.01])
    assert nearest_depths(stray.train, stray.points)[0] == pytest.approx(usual, rel=0.05)
    close = scene()
    close.train[1].viewmat[2, 3] = -3.0  # moves the camera three units forward
    assert nearest_depths(close.train, close.points) == pytest.approx([usual, 1.0], rel=0.1)
    assert near_plane(TrainConfig(), close) == pytest.approx(SHARE, rel=0.1)  # the nearest view decides


def test_without_points_in_view_the_cameras_tell() -> None:
    behind = scene()
    behind.points[:, 2] *= -1
    assert nearest_depths(behind.train, behind.points) == [None, None]
    assert near_plane(TrainConfig(), behind) == pytest.approx(SHARE_OF_EXTENT * 0.55)


def test_settings_go_first_and_must_lie_before_the_far_plane() -> None:
    assert near_plane(TrainConfig(near_plane=0.7), scene()) == 0.7
    with pytest.raises(InputError, match=r"near plane 0\.4.* is not below far_plane=0.3"):
        near_plane(TrainConfig(far_plane=0.3), scene())


def test_points_that_nothing_would_ever_draw_do_not_become_gaussians() -> None:
    scene_ = scene()
    left_lens, behind, right_lens = [0.5, 0.0, 0.1], [0.5, 0.0, -1.0], [-0.5, 0.0, 0.3]
    scene_.points[:3] = torch.tensor([left_lens, behind, right_lens])
    near = near_plane(TrainConfig(), scene_)
    assert before_a_lens(scene_.train, scene_.points, near).nonzero().flatten().tolist() == [0, 2]
    assert not before_a_lens(scene_.train, scene_.points, 0.05).any()
    trainer = Trainer(TrainConfig(max_steps=3), scene_)
    assert len(trainer.splats["means"]) == 998
    other = scene()
    other.points[0] = torch.tensor([0.5, 0.0, 0.2])
    assert before_a_lens(other.train, other.points, 0.4).nonzero().flatten().tolist() == [0]
    other.train[1].viewmat[2, 3] = 3.0  # this camera stands back and shows the space in front of the other
    assert not before_a_lens(other.train, other.points, 0.4).any()


def test_a_near_plane_behind_all_points_is_refused() -> None:
    with pytest.raises(
        InputError, match=r"All 1,000 points of .* are nearer than the near plane 50; lower --near-plane"
    ):
        Trainer(TrainConfig(max_steps=3, near_plane=50), scene())


def test_points_that_no_view_shows_get_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    Trainer(TrainConfig(max_steps=3), scene())
    assert not caplog.records
    behind = scene()
    behind.points[:, 2] *= -1
    Trainer(TrainConfig(max_steps=3), behind)
    assert "None of the 2 training views of two shows one of its 1000 points" in caplog.text
    caplog.clear()
    Trainer(TrainConfig(max_steps=3, far_plane=3.9), scene())
    assert "check that cameras and points have the same axes, unit and origin" in caplog.text
