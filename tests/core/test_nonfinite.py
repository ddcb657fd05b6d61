"""Losses that are not finite: skipped, raised or passed, never averaged."""

from __future__ import annotations

import math

import pytest
import torch

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core.errors import DivergedError
from skipgs_plug.core.nonfinite import NonFiniteGuard


def poison(value: float = math.nan) -> torch.Tensor:
    return torch.tensor(1.0, requires_grad=True) * value


def test_warns_once_per_view_with_step_and_mean() -> None:
    gate = SkipGate(start_iter=0)
    gate.backward(torch.tensor(0.25, requires_grad=True), view="a", step=0)
    what = r"iteration 1 on view 'a' \(mean of its finite losses 0.25\); its backward is skipped"
    with pytest.warns(RuntimeWarning, match=what):
        assert not gate.backward(poison(), view="a", step=1)
    assert not gate.backward(poison(), view="a", step=2)  # no second warning: it would be an error here
    assert gate.stats()["non_finite"] == 2
    assert gate.stats()["backwards_skipped"] == 2
    assert gate.view_table()[0]["mean_loss"] == 0.25


@pytest.mark.parametrize("mode", ["skip", "pass"])
def test_losses_that_stay_non_finite_are_an_error_in_a_loop_of_ones_own(mode: str) -> None:
    gate = SkipGate(start_iter=0, on_nonfinite=mode)
    with pytest.warns(RuntimeWarning):
        for step in range(9):
            assert gate.backward(poison(math.inf), view=f"v{step}", step=step) is (mode == "pass")
    with pytest.raises(DivergedError, match=r"inf in iteration 9 on view 'v9'.*9 losses before it"):
        gate.backward(poison(math.inf), view="v9", step=9)


def test_one_finite_loss_begins_the_count_anew() -> None:
    gate = SkipGate(start_iter=0)
    with pytest.warns(RuntimeWarning):
        for step in range(40):
            gate.backward(poison(math.nan if step % 10 else 1.0), view="a", step=step)
    assert gate.stats()["non_finite"] == 36


def test_an_epoch_of_many_views_is_waited_for() -> None:
    guard = NonFiniteGuard("skip")
    with pytest.warns(RuntimeWarning):
        for step in range(39):
            guard.answer(f"v{step}", math.nan, step, None, n_views=40)
    with pytest.raises(DivergedError, match="v39"):
        guard.answer("v39", math.nan, 39, None, n_views=40)


def test_can_raise_at_once() -> None:
    gate = SkipGate(start_iter=0, on_nonfinite="raise")
    with pytest.raises(SkipGSError, match="iteration 0 on view 'a'"):
        gate.backward(poison(), view="a", step=0)


def test_can_pass() -> None:
    gate = SkipGate(start_iter=0, on_nonfinite="pass")
    parameter = torch.nn.Parameter(torch.ones(1))
    with pytest.warns(RuntimeWarning, match="runs all the same"):
        assert gate.backward(parameter.sum() * math.nan, view="a", step=0)
    assert parameter.grad is not None
    assert gate.view_table()[0]["mean_loss"] is None


def test_before_start_it_is_the_trainers_own_affair() -> None:
    gate = SkipGate(start_iter=10)
    assert gate.backward(poison(), view="a", step=0)
    assert gate.stats()["non_finite"] == 0


@pytest.mark.parametrize(("mode", "backward"), [("skip", "was skipped"), ("pass", "ran all the same")])
def test_the_summary_of_a_gate_that_leaves_out_iterations_counts_them(mode: str, backward: str) -> None:
    gate = SkipGate(start_iter=0, refine_share=0.5, on_nonfinite=mode)
    with pytest.warns(RuntimeWarning, match="Loss is nan"):
        for step in gate.iterations(range(40)):
            loss = torch.tensor(math.nan if step % 4 == 0 else 1.0, requires_grad=True)
            gate.backward(loss, view=step % 4, step=step)
    count = gate.report()["non_finite"]
    assert 0 < count < 20
    assert f"in {count} of them the loss was not finite, and the backward {backward}" in gate.summary()
