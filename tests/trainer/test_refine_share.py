"""Iterations left out of the reference trainer: interrupted runs, trainers in turns, and counts."""

from __future__ import annotations

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.trainer import TrainConfig, Trainer
from skipgs_plug.trainer.synthetic import make_scene

STEPS = 120


@pytest.fixture(scope="module")
def scene():
    return make_scene(n_views=9, width=32, height=24, n_points=200)


def trainer_of(scene) -> Trainer:
    return Trainer(TrainConfig(max_steps=STEPS, seed=3), scene)


def left(trainer: Trainer) -> list[torch.Tensor]:
    return [parameter.detach().clone() for parameter in trainer.splats.values()]


@pytest.mark.parametrize("settings", [{}, {"compensate": False}], ids=["larger steps", "spread evenly"])
@pytest.mark.parametrize("at", [50, 70, 95])
def test_resumed_equals_uninterrupted(scene, tmp_path, settings, at) -> None:
    whole = trainer_of(scene)
    with SkipGate(whole, refine_share=0.4, **settings) as gate:
        whole.train(progress=False)
    assert (whole.step, whole.ran) == (STEPS, 60 + gate.report()["iterations_run"])
    first = trainer_of(scene)
    with SkipGate(first, refine_share=0.4, **settings):
        first.train(until=at, progress=False)
        first.save_checkpoint(tmp_path / "checkpoint.pt")
    second = trainer_of(scene)
    with SkipGate(second, refine_share=0.4, **settings) as resumed:
        second.load_checkpoint(tmp_path / "checkpoint.pt")
        second.train(progress=False)
    assert (second.step, second.ran) == (whole.step, whole.ran)
    assert all(torch.equal(one, two) for one, two in zip(left(whole), left(second), strict=True))
    for key in ("iterations_run", "iterations_skipped", "backwards_run", "reasons"):
        assert resumed.report()[key] == gate.report()[key]


def test_trainers_that_take_turns_do_not_scale_each_others_rates(scene) -> None:
    alone = trainer_of(scene)
    alone.train(progress=False)
    plain, shortened = trainer_of(scene), trainer_of(scene)
    with SkipGate(shortened, refine_share=0.4):
        for until in range(20, STEPS + 1, 20):
            shortened.train(until=until, progress=False)
            plain.train(until=until, progress=False)
    assert all(torch.equal(one, two) for one, two in zip(left(alone), left(plain), strict=True))


def test_multiples_are_met_where_numbers_are_left_out(scene) -> None:
    trainer, passed, completed = trainer_of(scene), [], []

    def look(iteration) -> None:
        passed.append(iteration.passes(10))
        completed.append(iteration.completes(10))

    trainer.on_step = look
    with SkipGate(trainer, refine_share=0.4):
        trainer.train(progress=False)
    # Iterations 0 to 83 run. Then only the last one does, and passes the other multiples.
    assert sum(passed) == 9 + 1 and sum(completed) == 8 + 1 and len(passed) == trainer.ran


def test_exposures_take_shorter_steps_not_larger_ones(scene) -> None:
    trainer = Trainer(TrainConfig(max_steps=STEPS, seed=3, exposure=True), scene)
    assert trainer.exposure is not None
    taken: dict[int, float] = {}
    own: dict[int, float] = {}
    schedule = trainer.exposure.set_learning_rate

    def note(optimizer: torch.optim.Optimizer, *_: object) -> None:
        taken[trainer.step] = optimizer.param_groups[0]["lr"]

    def scheduled(progress: float) -> None:
        schedule(progress)
        own[trainer.step] = trainer.all_optimizers[-1].param_groups[0]["lr"]

    trainer.exposure.optimizer.register_step_pre_hook(note)
    trainer.exposure.set_learning_rate = scheduled  # type: ignore[method-assign]
    with SkipGate(trainer, refine_share=0.4):
        trainer.train(progress=False)
    part = {step: lr / own[step] for step, lr in taken.items()}
    refined = [part[step] for step in sorted(part) if step >= trainer.refine_stop_iter]
    assert all(value == 1.0 for step, value in part.items() if step < trainer.refine_stop_iter)
    assert max(refined) == pytest.approx(0.25) and refined == sorted(refined, reverse=True) and refined[-1] < 0.05


def test_a_run_that_is_trained_in_parts_is_planned_as_a_whole(scene) -> None:
    """The first loop says where it ends, not where the run does: events of later parts are known all the same."""
    config = TrainConfig(max_steps=600, seed=3)  # densification ends at 300, with events at 100 and 200
    whole, parted = Trainer(config, scene), Trainer(config, scene)
    with SkipGate(whole, share=0.4) as one:
        whole.train(progress=False)
    with SkipGate(parted, share=0.4) as other:
        for until in (60, 150, 320, 600):
            parted.train(until=until, progress=False)
    assert other.report()["growing"] == one.report()["growing"]
    assert one.report()["growing"]["events_run"] == 2
    assert (parted.step, parted.ran) == (whole.step, whole.ran)
    assert all(torch.equal(a, b) for a, b in zip(left(whole), left(parted), strict=True))
