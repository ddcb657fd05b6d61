"""A gated loop beside a plain one: off and never-skipping are the same run, bit for bit."""

from __future__ import annotations

import pytest
import torch
from always import Always

from skipgs_plug import SkipGate

STEPS = 300


def equal(a: list[torch.Tensor], b: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize(
    "settings",
    [
        {"enabled": False},
        {"start_iter": STEPS},
        {"start_iter": 50, "warmup": STEPS},
    ],
)
def test_a_gate_that_never_skips_changes_no_bit(tiny_loop, settings) -> None:
    plain, gated = tiny_loop(), tiny_loop()
    gate = SkipGate(**settings)
    assert equal(plain.train(STEPS), gated.train(STEPS, gate))
    assert gate.stats()["backwards_skipped"] == 0
    assert plain.optimizer.state_dict()["state"][0]["step"] == gated.optimizer.state_dict()["state"][0]["step"]


def test_a_gate_that_skips_does_change_the_run(tiny_loop) -> None:
    plain, gated = tiny_loop(), tiny_loop()
    gate = SkipGate(start_iter=50, warmup=50)
    before, after = plain.train(STEPS), gated.train(STEPS, gate)
    assert equal(before[:100], after[:100])
    assert not torch.equal(before[-1], after[-1])
    stats = gate.stats()
    assert stats["gated_iterations"] == STEPS - 50
    assert stats["backwards_run"] + stats["backwards_skipped"] == stats["gated_iterations"]
    assert stats["backwards_skipped"] > 0
    assert gated.optimizer.state_dict()["state"][0]["step"] == 50 + stats["backwards_run"]


def test_always_skipping_leaves_parameters_alone(tiny_loop) -> None:
    history = tiny_loop().train(STEPS, SkipGate(start_iter=50, policy=Always()))
    assert not torch.equal(history[0], history[49])
    assert equal(history[49:], [history[49]] * (STEPS - 49))


def test_one_poisoned_iteration_is_one_left_out(tiny_loop) -> None:
    """NaN at one step: as if that step had been skipped, in parameters and optimizer state."""
    loop, reference = tiny_loop(), tiny_loop()
    loop.poisoned = {120}
    gate = SkipGate(start_iter=50, warmup=STEPS)
    with pytest.warns(RuntimeWarning, match="iteration 120"):
        history = loop.train(STEPS, gate)

    def left_out(step: int, loss: torch.Tensor) -> None:
        if step != 120:
            loss.backward()

    for step in range(STEPS):
        loss, _ = reference.loss(step)
        left_out(step, loss)
        reference.optimizer.step()
        reference.optimizer.zero_grad(set_to_none=True)
    assert torch.equal(history[-1], reference.parameter.detach())
    assert gate.stats()["non_finite"] == 1
    assert all(torch.isfinite(torch.tensor(row["mean_loss"])) for row in gate.view_table())


@pytest.mark.parametrize("cut", [30, 60, 99, 100, 101, 180])
def test_interrupted_and_resumed_is_uninterrupted(tiny_loop, cut: int) -> None:
    settings = {"start_iter": 50, "warmup": 50, "record_trace": True, "pause_iters": 20}

    def train(loop, gate: SkipGate, begin: int, end: int) -> torch.Tensor:
        if begin <= 150 < end:
            history = loop.train(150 - begin, gate, begin)
            gate.notify_event("prune", step=150)
            return loop.train(end - 150, gate, 150)[-1] if end > 150 else history[-1]
        return loop.train(end - begin, gate, begin)[-1]

    whole, parts = tiny_loop(), tiny_loop()
    one, first, second = SkipGate(**settings), SkipGate(**settings), SkipGate(**settings)
    expected = train(whole, one, 0, STEPS)
    train(parts, first, 0, cut)
    second.load_state_dict(first.state_dict())
    assert torch.equal(train(parts, second, cut, STEPS), expected)
    assert first.trace + second.trace == one.trace
    done, counted = one.stats(), second.stats()
    assert {k: v for k, v in done.items() if not k.startswith("t_")} == {
        k: v for k, v in counted.items() if not k.startswith("t_")
    }


def test_learning_rate_schedules_run_on_skipped_iterations(tiny_loop) -> None:
    loop = tiny_loop()
    scheduler = torch.optim.lr_scheduler.ExponentialLR(loop.optimizer, gamma=0.9)
    gate = SkipGate(start_iter=1, policy=Always())
    for step in range(5):
        loss, view = loop.loss(step)
        gate.backward(loss, view=view, step=step)
        gate.step(loop.optimizer)
        scheduler.step()
    assert loop.optimizer.param_groups[0]["lr"] == pytest.approx(0.02 * 0.9**5)
