"""Growth on photographs of half the size."""

from __future__ import annotations

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.half_size import half_size
from skipgs_plug.trainer.iteration import Iteration
from skipgs_plug.trainer.scene import View
from skipgs_plug.trainer.synthetic import make_scene


def make_view(height: int, width: int, masked: bool = False) -> View:
    image = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    K = torch.tensor([[50.0, 0.0, 0.45 * width], [0.0, 60.0, 0.55 * height], [0.0, 0.0, 1.0]], dtype=torch.float64)
    mask = torch.rand(height, width) < 0.8 if masked else None
    return View("a.png", image, K, torch.eye(4, dtype=torch.float64), mask)


def test_each_pixel_is_the_mean_of_four() -> None:
    view = make_view(25, 32)
    half = half_size(view)
    fours = view.image[:24].reshape(12, 2, 16, 2, 3).double().mean(dim=(1, 3))
    assert half.image.dtype == torch.uint8 and (half.image.double() - fours).abs().max() <= 0.5
    assert half.name == view.name and half.viewmat is view.viewmat


def test_a_point_lies_at_half_the_pixel_coordinates() -> None:
    view = make_view(24, 33)
    point = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    full, half = view.K @ point, half_size(view).K @ point
    assert torch.allclose(half[:2] / half[2], full[:2] / full[2] / 2)


def test_a_pixel_counts_if_all_four_count() -> None:
    view = make_view(24, 33, masked=True)
    assert view.mask is not None
    mask = half_size(view).mask
    assert mask is not None and mask.any() and not mask.all()
    assert torch.equal(mask, view.mask[:, :32].reshape(12, 2, 16, 2).all(dim=3).all(dim=1))


def test_a_view_too_small_for_ssim_keeps_its_size() -> None:
    view = make_view(21, 40)
    assert half_size(view) is view


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_the_scene_grows_on_half_size_in_the_first_half_of_the_run_at_most(strategy: str) -> None:
    scene = make_scene(n_views=10, width=48, height=36, n_points=160)
    sizes: dict[int, tuple[int, ...]] = {}
    trainer = Trainer(TrainConfig(max_steps=40, strategy=strategy), scene)

    def note(done: Iteration) -> None:
        assert done.image.shape == done.target.shape
        sizes[done.step] = tuple(done.image.shape)

    trainer.on_step = note
    with SkipGate(trainer, share=1.0, half_size=True) as gate:
        trainer.train(progress=False)
    assert sizes == {step: (18, 24, 3) if step < 20 else (36, 48, 3) for step in range(40)}
    assert gate.report()["growing"]["half_size_until"] == 20
    assert "photographs had half their size until iteration 20" in gate.summary()
    assert trainer.render(scene.test[0]).shape == (36, 48, 3)


@pytest.mark.parametrize("smooth", [True, False])
def test_auto_asks_the_photographs_and_a_resumed_run_keeps_the_answer(smooth: bool) -> None:
    scene = make_scene(n_views=10, width=48, height=36, n_points=160)
    if smooth:
        for view in scene.train:
            view.image[:] = torch.linspace(0, 255, 48)[:, None]
    trainer = Trainer(TrainConfig(max_steps=400), scene)
    with SkipGate(trainer, share="auto") as gate:
        trainer.train(until=30, progress=False)
        saved = trainer.snapshot()
        until = gate.report()["growing"]["half_size_until"]
    assert until == (200 if smooth else 0)
    sizes = set()
    again = Trainer(TrainConfig(max_steps=400), scene)
    again.on_step = lambda done: sizes.add(tuple(done.image.shape))
    with SkipGate(again, share="auto") as gate:
        again.restore(saved)
        again.train(until=60, progress=False)
        assert gate.report()["growing"]["half_size_until"] == until
    assert sizes == {(18, 24, 3) if smooth else (36, 48, 3)}
