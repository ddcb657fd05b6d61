"""Rows in the order of space: everything that belongs to a Gaussian moves with it, and training goes on as before."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch
from test_resume import assert_same
from torch import Tensor

from skipgs_plug.trainer import Scene, TrainConfig, Trainer, densification, row_order
from skipgs_plug.trainer.row_order import morton_order, sort_rows, sorts_rows


def ranked(trainer: Trainer) -> dict[str, Tensor]:
    """Parameters and their moments with rows in an order that does not depend on theirs."""
    order = trainer.splats["means"][:, 0].argsort()
    state = trainer.snapshot()
    tensors = dict(state["splats"])
    for name, moments in state["optimizers"].items():
        tensors |= {f"{key} of {name}": moments[key] for key in ("exp_avg", "exp_avg_sq")}
    return {name: tensor[order] for name, tensor in tensors.items()}


def test_training_goes_on_with_the_same_gaussians(tiny_scene: Scene, tiny_config: TrainConfig) -> None:
    trainer = Trainer(dataclasses.replace(tiny_config, refine_stop_iter=1), tiny_scene)  # no densification
    trainer.train(until=20, progress=False)
    before = trainer.snapshot()
    trainer.train(until=26, progress=False)
    in_file_order = ranked(trainer)
    trainer.restore(before)
    parameters = dict(trainer.splats.items())
    sort_rows(trainer.splats, trainer.optimizers, trainer.strategy_state)
    assert not torch.equal(trainer.splats["means"], before["splats"]["means"])  # Gaussians have moved in training
    assert all(trainer.splats[name] is param for name, param in parameters.items())
    trainer.train(until=26, progress=False)
    for name, tensor in ranked(trainer).items():
        assert torch.equal(tensor, in_file_order[name]), name


def test_the_strategys_sums_move_with_their_rows(trainer: Trainer) -> None:
    n = len(trainer.splats["means"])
    trainer.strategy_state["count"] = torch.arange(n, dtype=torch.float32)
    before = trainer.splats["means"].detach().clone()
    sort_rows(trainer.splats, trainer.optimizers, trainer.strategy_state)
    assert torch.equal(before[trainer.strategy_state["count"].long()], trainer.splats["means"])
    assert trainer.strategy_state["scene_scale"] == pytest.approx(trainer.scene.scene_scale)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_run_sorts_and_resumes_in_that_order(
    tmp_path: Path, tiny_scene: Scene, tiny_config: TrainConfig, monkeypatch: pytest.MonkeyPatch, strategy: str
) -> None:
    tiny_config = dataclasses.replace(tiny_config, strategy=strategy)
    sorted_at: list[int] = []

    def noted(means: Tensor) -> Tensor:
        sorted_at.append(whole.step)
        return morton_order(means)

    for module in (densification, row_order):
        monkeypatch.setattr(module, "morton_order", noted)
    whole = Trainer(tiny_config, tiny_scene)
    whole.train(progress=False)
    assert sorted_at and all(sorts_rows(whole.strategy or whole.mcmc, step) for step in sorted_at)
    assert not sorts_rows(whole.strategy or whole.mcmc, sorted_at[0] + 1)
    assert sorted_at[-1] >= whole.refine_stop_iter - (whole.strategy or whole.mcmc).refine_every  # the last refinement
    monkeypatch.undo()
    for stop in (sorted_at[0], sorted_at[0] + 1):
        first = Trainer(tiny_config, tiny_scene)
        first.train(until=stop, progress=False)
        first.save_checkpoint(tmp_path / "c.pt")
        second = Trainer(tiny_config, tiny_scene)
        second.load_checkpoint(tmp_path / "c.pt")
        second.train(progress=False)
        assert_same(whole, second)


def test_neighbours_in_space_become_neighbours_in_memory() -> None:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(20_000, 3, generator=generator)
    means[::100] *= 1e6  # a few far away must not put all others into one cell
    order = morton_order(means)
    assert torch.equal(order.sort().values, torch.arange(len(means)))
    near = means[order][means[order].norm(dim=1) < 10]
    steps = (near[1:] - near[:-1]).norm(dim=1).median()
    assert steps < 0.2 * (means[1:] - means[:-1]).norm(dim=1).median()


def test_a_run_begins_in_the_order_of_space(trainer: Trainer) -> None:
    n = trainer.num_gaussians
    assert torch.equal(morton_order(trainer.splats["means"].detach()), torch.arange(n))
    assert not torch.equal(morton_order(trainer.scene.points), torch.arange(n))


def test_one_place_keeps_the_order() -> None:
    assert torch.equal(morton_order(torch.ones(5, 3)), torch.arange(5))
