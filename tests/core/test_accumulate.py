"""Optimizer steps on accumulated gradients, by the authors' constants."""

from __future__ import annotations

import math

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.core.accumulate import MAX_ACCUMULATED, StepAccumulator, gradient_norm


def test_snr_waits_until_the_signal_has_caught_up_with_the_noise() -> None:
    steps = StepAccumulator("snr")
    # Gradients that all agree: |n g|^2 >= 2 n |g|^2 from n = 2 on.
    steps.observe(1.0)
    assert not steps.due()
    steps.observe(2.0)
    assert steps.due()
    steps.reset()
    # Gradients at right angles: |sum|^2 = n never reaches 2 n; the cap steps in the end.
    for n in range(1, MAX_ACCUMULATED + 1):
        assert not steps.due()
        steps.observe(math.sqrt(n))
    assert steps.due()
    steps.reset()
    assert not steps.due()


def test_ref_k_waits_for_sixteen_gradients_worth() -> None:
    steps = StepAccumulator("ref_k")
    for n in range(1, 16):
        steps.observe(float(n))
        assert not steps.due()
    steps.observe(16.0)
    assert steps.due()


def test_reference_is_a_running_mean_of_first_gradients() -> None:
    steps = StepAccumulator("ref_k")
    steps.observe(1.0)
    steps.reset()
    steps.observe(11.0)  # mean 0.9 * 1 + 0.1 * 11 = 2, so 32 is asked for
    steps.observe(31.9)
    assert not steps.due()
    steps.observe(32.1)
    assert steps.due()


def test_nothing_accumulated_is_nothing_due() -> None:
    assert not StepAccumulator("snr").due()


def test_visibility_is_the_union_over_the_window() -> None:
    steps = StepAccumulator("snr")
    a, b = torch.tensor([True, False, False]), torch.tensor([False, True, False])
    assert steps.see(a).tolist() == [True, False, False]
    assert steps.see(b).tolist() == [True, True, False]
    steps.observe(1.0)
    steps.reset()
    assert steps.see(b).tolist() == [False, True, False]
    # Densification changes the number of Gaussians, and the window with it.
    assert steps.see(torch.tensor([True])).tolist() == [True]


def test_norm_is_that_of_all_gradients_together() -> None:
    a, b, c = (torch.nn.Parameter(torch.zeros(2)) for _ in range(3))
    assert gradient_norm([a, b]) == 0.0
    a.grad, b.grad = torch.tensor([3.0, 0.0]), torch.tensor([0.0, 4.0])
    assert gradient_norm([a, b, c]) == pytest.approx(5.0)


@pytest.mark.parametrize("trigger", ["snr", "ref_k"])
def test_gate_steps_on_the_sum_of_a_window(trigger: str) -> None:
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    gate = SkipGate(start_iter=3, warmup=2, min_bwd_ratio=0.0, step_mode="adaptive_norm", step_trigger=trigger)
    stepped = []
    for step in range(40):
        # New views are never skipped, so every iteration has a backward with the same gradient.
        gate.backward(parameter.sum(), view=f"v{step}", step=step)
        mask = torch.tensor([step % 2 == 0, step % 2 == 1])
        union = gate.visible(mask)
        if gate.step(optimizer):
            optimizer.zero_grad(set_to_none=True)
            stepped.append(step)
            if step >= 5:
                assert union.all()
    window = 2 if trigger == "snr" else 16
    assert stepped[:5] == [0, 1, 2, 3, 4]
    assert stepped[5:] == list(range(4 + window, 40, window))
    # No gradient is lost: every step applied the sum of its window.
    assert parameter.tolist() == [-float(stepped[-1] + 1)] * 2


def test_skipped_iterations_keep_the_window() -> None:
    parameter = torch.nn.Parameter(torch.ones(1))
    optimizer = torch.optim.SGD([parameter], lr=0.0)
    gate = SkipGate(start_iter=0, warmup=0, min_bwd_ratio=0.0, step_mode="adaptive_norm")
    gate.backward(parameter.sum() * 2.0, view="a", step=0)
    assert not gate.step(optimizer)
    assert not gate.backward(parameter.sum() * 1.0, view="a", step=1)
    assert not gate.step(optimizer)
    assert parameter.grad is not None
    gate.backward(parameter.sum() * 3.0, view="a", step=2)
    assert gate.step(optimizer)
    assert parameter.grad.item() == 5.0


def test_state_outlives_a_window() -> None:
    first, second = StepAccumulator("ref_k"), StepAccumulator("ref_k")
    first.observe(2.0)
    first.reset()
    first.observe(2.0)
    second.load_state_dict(first.state_dict())
    second.observe(2.0)
    second.observe(32.0)
    assert second.due()
