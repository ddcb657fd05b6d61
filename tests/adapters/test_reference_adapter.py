"""The gate on our own trainer: same bits when it does not skip, exact resume, nothing left behind."""

from __future__ import annotations

import pytest
import torch
from always import Always

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.synthetic import make_scene

STEPS = 60


@pytest.fixture(scope="module")
def scene() -> Scene:
    return make_scene(n_views=8, width=24, height=16, n_points=60, test_every=8)


@pytest.fixture
def trainer(scene: Scene) -> Trainer:
    """At the end of densification."""
    trainer = Trainer(TrainConfig(max_steps=STEPS), scene)
    trainer.train(until=trainer.refine_stop_iter, progress=False)
    return trainer


def parameters(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: value.detach().clone() for name, value in trainer.splats.items()}


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_off_and_never_skipping_change_no_bit(trainer: Trainer) -> None:
    snapshot = trainer.snapshot()
    trainer.train(progress=False)
    plain = parameters(trainer)
    for settings in ({"enabled": False}, {"warmup": STEPS}):
        trainer.restore(snapshot)
        with SkipGate(trainer, **settings) as gate:
            trainer.train(progress=False)
            gate.verify()
        assert equal(parameters(trainer), plain)
        assert gate.stats()["iterations"] == STEPS - trainer.refine_stop_iter


def test_always_skipping_keeps_the_parameters(trainer: Trainer) -> None:
    before = parameters(trainer)
    with SkipGate(trainer, policy=Always()) as gate:
        trainer.train(progress=False)
    assert equal(parameters(trainer), before)
    assert gate.stats()["backwards_skipped"] == STEPS - trainer.refine_stop_iter
    assert trainer.step == STEPS


def test_settings_are_scaled_with_the_schedule(trainer: Trainer) -> None:
    with SkipGate(trainer) as gate:
        n_views = len(trainer.view_names)
        assert gate.config.start_iter == trainer.refine_stop_iter
        assert (gate.config.warmup, gate.config.pause_iters) == (2 * n_views, n_views)
    with SkipGate(trainer, warmup=5, pause_iters=3) as gate:
        assert (gate.config.warmup, gate.config.pause_iters) == (5, 3)


def test_interrupted_and_resumed_is_uninterrupted(trainer: Trainer, scene: Scene, tmp_path) -> None:
    with SkipGate(trainer, warmup=4, record_trace=True) as gate:
        trainer.train(until=STEPS - 12, progress=False)
        trainer.save_checkpoint(tmp_path / "ckpt.pt")
        seen = len(gate.trace)
        trainer.train(progress=False)
    resumed = Trainer(TrainConfig(max_steps=STEPS), scene)
    with SkipGate(resumed, warmup=4, record_trace=True) as other:
        resumed.load_checkpoint(tmp_path / "ckpt.pt")
        resumed.train(progress=False)
    assert equal(parameters(resumed), parameters(trainer))
    assert other.trace == gate.trace[seen:]
    assert any(row.skip for row in other.trace)
    assert other.view_table() == gate.view_table()


def test_seconds_are_the_trainers_own(trainer: Trainer) -> None:
    with SkipGate(trainer) as gate:
        trainer.train(progress=False)
    stats = gate.stats()
    assert (stats["t_total"], stats["t_post"]) == (trainer.t_total, trainer.t_post)
    processor = trainer.clock.processor
    assert (stats["t_total_processor"], stats["t_post_processor"]) == (processor.total, processor.post)
    assert 0 < processor.post < processor.total


def test_nothing_is_left_behind(trainer: Trainer) -> None:
    gate = SkipGate(trainer)
    assert gate.patched == ["skipgs_plug.trainer.loop.Trainer.backward", "Trainer.registered['skipgs']"]
    with pytest.raises(SkipGSError, match="gated already"):
        SkipGate(trainer)
    gate.detach()
    assert "backward" not in vars(trainer)
    assert trainer.registered == {}
    SkipGate(trainer).detach()


def test_a_snapshot_from_before_needs_a_new_gate(trainer: Trainer) -> None:
    snapshot = trainer.snapshot()
    gate = SkipGate(trainer)
    trainer.train(until=trainer.step + 3, progress=False)
    trainer.restore(snapshot)
    with pytest.raises(SkipGSError, match="went back"):
        trainer.train(progress=False)
    assert gate.patched == []
