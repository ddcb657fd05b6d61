"""An adapter's hooks, on a trainer of twenty lines: they gate its backward passes, and detach leaves nothing."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from always import Always
from toy_trainer import Toy, ToyTrainer, attach, plain

from skipgs_plug import SkipGate
from skipgs_plug.core.policy import SkipPolicy


class ScaledTrainer(ToyTrainer):
    """Scales its loss, as mixed precision needs it."""

    def train(self) -> None:
        scaler = torch.amp.GradScaler("cpu")
        for step in range(self.steps):
            self.begin(step)
            scaler.scale((self.render(f"v{step % 10}") ** 2).mean()).backward()
            scaler.unscale_(self.optimizer)
            scaler.step(self.optimizer)
            scaler.update()
            self.optimizer.zero_grad(set_to_none=True)


def test_gates_counts_and_leaves_nothing_behind() -> None:
    trainer = ToyTrainer()
    with attach(trainer) as gate:
        assert len(gate.patched) == 10
        trainer.train()
        gate.verify()
    assert plain(trainer)
    assert gate.patched == []
    stats = gate.stats()
    assert (stats["iterations"], stats["gated_iterations"]) == (100, 80)
    assert stats["reasons"]["warm-up"] == 12
    assert stats["reasons"]["forced"] == 1
    assert stats["paused"] == 15
    assert stats["events"] == {"prune": 1}
    assert stats["backwards_skipped"] > 0
    assert trainer.noise == 100 - stats["backwards_skipped"]
    assert gate.config.start_iter == 20
    assert 0 < stats["t_post"] < stats["t_total"]


def test_no_default_replaces_a_setting_of_the_user() -> None:
    trainer = ToyTrainer()
    with attach(trainer, start_iter=50, warmup=3) as gate:
        assert (gate.config.start_iter, gate.config.warmup, gate.config.pause_iters) == (50, 3, 15)


@pytest.mark.parametrize("settings", [{"enabled": False}, {"warmup": 1000}])
def test_never_skipping_changes_no_bit(settings) -> None:
    expected, trainer = ToyTrainer(), ToyTrainer()
    expected.train()
    with attach(trainer, **settings):
        trainer.train()
    assert torch.equal(expected.parameter, trainer.parameter)
    assert trainer.noise == 100


def test_a_loss_scaler_survives_iterations_without_gradients() -> None:
    trainer, never = ScaledTrainer(), ScaledTrainer()
    with attach(trainer, policy=Always()) as gate:
        trainer.train()
    assert gate.released is None and gate.stats()["backwards_skipped"] == 79
    assert trainer.optimizer.state[trainer.parameter]["step"] == 21
    assert gate.patched == []
    with attach(never, warmup=100):
        never.train()
    plain_one = ScaledTrainer()
    plain_one.train()
    assert torch.equal(never.parameter, plain_one.parameter)


def test_always_skipping_keeps_parameters_but_for_forced_iterations() -> None:
    policy = Always()
    trainer = ToyTrainer(45)
    with attach(trainer, policy=policy):
        trainer.train()
    expected = ToyTrainer(20)
    expected.train()
    assert torch.equal(expected.parameter, trainer.parameter)
    assert policy.asked == list(range(20, 45))


def test_a_signal_is_decided_on_in_its_own_iteration_only() -> None:
    class Signalling(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.before(self.trainer, "measure", lambda step: hooks.signal(123.0) if step == 30 else None)

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Signalling(trainer), record_trace=True) as gate:
        trainer.train()
    assert [row.step for row in gate.trace if row.loss == 123.0] == [30]


def test_detach_undoes_further_changes_of_an_adapter() -> None:
    undone = []

    class Listing(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.on_detach("trainer.registry", lambda: undone.append(1))

    trainer = ToyTrainer()
    gate = SkipGate(trainer, adapter=Listing(trainer))
    assert "trainer.registry" in gate.patched
    gate.detach()
    gate.detach()
    assert undone == [1]


def test_detaches_on_an_exception_in_training() -> None:
    trainer = ToyTrainer()
    trainer.add_noise = lambda: 1 / 0  # type: ignore[method-assign]
    with pytest.raises(ZeroDivisionError), attach(trainer):
        trainer.train()
    del trainer.add_noise
    assert plain(trainer)


def test_a_trainer_may_count_with_numpy() -> None:
    class Counted(Toy):
        def attach(self, hooks) -> None:
            super().attach(hooks)
            hooks.iteration(np.int64(7))

    trainer = ToyTrainer()
    with SkipGate(trainer, adapter=Counted(trainer)) as gate:
        assert json.loads(json.dumps(gate.state_dict()))["step"] == 7


def test_a_training_under_way_is_not_lost_when_the_gate_fails(monkeypatch) -> None:
    """An error of the gate's own code releases it: the rest of the run trains as without a gate."""

    def fails(self, view, loss, step):
        if step == 50:
            raise ZeroDivisionError("of the policy")
        return original(self, view, loss, step)

    original = SkipPolicy.decide
    monkeypatch.setattr(SkipPolicy, "decide", fails)
    trainer = ToyTrainer()
    gate = attach(trainer)
    with pytest.warns(RuntimeWarning, match=r"released in iteration 50, .*ZeroDivisionError: of the policy"):
        trainer.train()
    assert plain(trainer) and gate.patched == []
    assert gate.stats()["gated_iterations"] < 50


def test_an_error_of_the_trainers_own_backward_stays_its_own() -> None:
    trainer = ToyTrainer()
    with attach(trainer) as gate:
        with pytest.raises(MemoryError):
            gate._hooks.iteration(0)  # type: ignore[union-attr]
            gate._hooks.backward(torch.ones((), requires_grad=True), lambda: (_ for _ in ()).throw(MemoryError()), "v0")  # type: ignore[union-attr]
        assert gate.patched
