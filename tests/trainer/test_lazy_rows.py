"""Higher bands of rows that no view shows are stepped later: nobody can tell from outside."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.fallback_raster.training.lazy_adam import LazyAdam
from skipgs_plug.fallback_raster.training.optimizer import Adam
from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.backend import CpuBackend
from skipgs_plug.trainer.loop import Iteration
from skipgs_plug.trainer.row_order import sort_rows
from skipgs_plug.trainer.scene import View
from skipgs_plug.trainer.synthetic import make_scene

CONFIG = TrainConfig(max_steps=60, refine_every=4, sh_degree_interval=5000)
CONFIGS = {
    "default": CONFIG,
    "moves and noise": dataclasses.replace(CONFIG, strategy="mcmc", cap_max=400),
    "higher bands at once": dataclasses.replace(CONFIG, sh_degree_interval=1),
}


@pytest.fixture(scope="module")
def narrow_scene() -> Scene:
    """Each view shows less than half of the Gaussians: twice the focal length, turned to one side or the other."""
    scene = make_scene(n_views=10, width=32, height=24, n_points=160)

    def narrowed(view: View, number: int) -> View:
        K = view.K.clone()
        K[:2, :2] *= 2.5
        K[0, 2] += 24.0 if number % 2 else -24.0
        return dataclasses.replace(view, K=K)

    views = [narrowed(view, number) for number, view in enumerate(scene.train)]
    return dataclasses.replace(scene, train=views)


def assert_same(one: Trainer, other: Trainer) -> None:
    first, second = one.snapshot(), other.snapshot()
    for name in first["splats"]:
        assert torch.equal(first["splats"][name], second["splats"][name]), name
        for key, moment in first["optimizers"][name].items():
            assert torch.equal(moment, second["optimizers"][name][key]), (name, key)


def dense(monkeypatch: pytest.MonkeyPatch, config: TrainConfig, scene: Scene) -> Trainer:
    """A trainer that updates all rows in every iteration."""
    with monkeypatch.context() as context:
        context.setattr(
            CpuBackend,
            "create_adam",
            lambda _, name, param, rate, eps: Adam([{"params": [param], "lr": rate, "name": name}], eps=eps),
        )
        return Trainer(config, scene)


def behind(trainer: Trainer) -> int:
    """How many rows missed a step that would have moved them."""
    before = trainer._splats["shN"].detach().clone()
    now = trainer.splats["shN"].detach()
    return int((before != now).any(dim=-1).any(dim=-1).sum())


@pytest.mark.parametrize("name", CONFIGS)
def test_a_run_is_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch, narrow_scene: Scene, name: str) -> None:
    lazy, all_rows = Trainer(CONFIGS[name], narrow_scene), dense(monkeypatch, CONFIGS[name], narrow_scene)
    for trainer in (lazy, all_rows):
        trainer.train(until=55, progress=False)
        for _ in range(5):
            trainer.train_step()
    assert behind(lazy) > 10 and behind(all_rows) == 0
    assert_same(lazy, all_rows)


def test_after_training_those_who_kept_the_parameters_see_all_rows_up_to_date(narrow_scene: Scene) -> None:
    trainer = Trainer(CONFIG, narrow_scene)
    trainer.train(until=40, progress=False)
    kept = trainer.splats["shN"]
    trainer.train(until=50, progress=False)
    assert kept is trainer._splats["shN"] and behind(trainer) == 0


LOOKS: dict[str, Callable[[Trainer, Path], Any]] = {
    "snapshot": lambda trainer, folder: trainer.snapshot(),
    "checkpoint": lambda trainer, folder: trainer.save_checkpoint(folder / "c.pt"),
    "evaluation": lambda trainer, folder: trainer.evaluate("train"),
    "render": lambda trainer, folder: trainer.render(trainer.scene.train[3]),
    "PLY": lambda trainer, folder: trainer.export_ply(folder / "p.ply"),
    "parameters": lambda trainer, folder: {name: value.detach().clone() for name, value in trainer.splats.items()},
}


@pytest.mark.parametrize("look", LOOKS)
def test_who_looks_sees_all_rows_up_to_date_and_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, narrow_scene: Scene, look: str
) -> None:
    config = CONFIGS["higher bands at once"]
    trainers = Trainer(config, narrow_scene), dense(monkeypatch, config, narrow_scene)
    found: list[list[Any]] = [[], []]
    for trainer, seen in zip(trainers, found, strict=True):

        def watch(iteration: Iteration, trainer: Trainer = trainer, seen: list[Any] = seen) -> None:
            if iteration.step % 7 == 5:
                seen.append(LOOKS[look](trainer, tmp_path))
                if look == "PLY":
                    seen.append((tmp_path / "p.ply").read_bytes())

        trainer.on_step = watch
        trainer.train(progress=False)
    assert len(found[0]) >= 8
    for one, other in zip(*found, strict=True):
        assert_equal(one, other)
    assert_same(*trainers)


def assert_equal(one: Any, other: Any) -> None:
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        for name in one.keys() - {"clock"}:
            assert_equal(one[name], other[name])
    else:
        assert one == other


@pytest.mark.parametrize("stop", [7, 29, 44])
def test_resumed_equals_uninterrupted(tmp_path: Path, narrow_scene: Scene, stop: int) -> None:
    config = CONFIGS["higher bands at once"]
    whole, first, second = (Trainer(config, narrow_scene) for _ in range(3))
    whole.train(progress=False)
    first.train(until=stop, progress=False)
    first.save_checkpoint(tmp_path / "c.pt")
    second.load_checkpoint(tmp_path / "c.pt")
    second.train(progress=False)
    assert_same(whole, second)
    snapshot = second.snapshot()
    second.step -= 2
    second.ran -= 2
    second.train(progress=False)
    second.restore(snapshot)
    assert_same(whole, second)


@pytest.mark.parametrize("settings", [{"warmup": 2}, {"refine_share": 0.5}])
def test_a_gate_leaves_steps_out_of_both(
    monkeypatch: pytest.MonkeyPatch, narrow_scene: Scene, settings: dict[str, Any]
) -> None:
    trainers = Trainer(CONFIG, narrow_scene), dense(monkeypatch, CONFIG, narrow_scene)
    for trainer in trainers:
        SkipGate(trainer, **settings)
        trainer.train(progress=False)
    assert_same(*trainers)


def test_gradients_that_wait_for_their_step_are_sorted_with_their_rows(
    monkeypatch: pytest.MonkeyPatch, narrow_scene: Scene
) -> None:
    config = dataclasses.replace(CONFIGS["higher bands at once"], refine_stop_iter=1)  # no densification
    trainer = Trainer(config, narrow_scene)
    trainer.train(until=20, progress=False)
    snapshot, found = trainer.snapshot(), []
    for sorts in (False, True):
        trainer.restore(snapshot)
        with monkeypatch.context() as context:
            # Stands for a gate that accumulates gradients: no optimizer steps.
            context.setattr("skipgs_plug.trainer.loop.step_optimizers", lambda *given: False)
            trainer.train_step()
        assert trainer._splats["shN"].grad.factors is not None
        if sorts:
            sort_rows(trainer.splats, trainer.optimizers, trainer.strategy_state)
            assert not torch.equal(trainer.splats["means"], snapshot["splats"]["means"])
        trainer.train(until=24, progress=False)
        order = trainer.splats["means"][:, 0].argsort()
        found.append({name: param.detach()[order] for name, param in trainer.splats.items()})
    for name, tensor in found[0].items():
        assert torch.equal(tensor, found[1][name]), name


def test_only_plain_adam_on_the_cpu_is_lazy(narrow_scene: Scene) -> None:
    for options in ({"visible_adam": True}, {"sh_degree": 0}):
        trainer = Trainer(dataclasses.replace(CONFIG, **options), narrow_scene)
        assert not any(isinstance(optimizer, LazyAdam) for optimizer in trainer.optimizers.values())
        trainer.train(until=3, progress=False)
    lazy = {name for name, one in Trainer(CONFIG, narrow_scene).optimizers.items() if isinstance(one, LazyAdam)}
    assert lazy == {"shN"}
