"""The floor on real backwards."""

from __future__ import annotations

from skipgs_plug.core.budget import MIN_SAMPLES, BackwardBudget


def test_comes_into_force_after_the_minimum_of_samples() -> None:
    assert MIN_SAMPLES == 100  # as in the authors' controller
    budget = BackwardBudget(0.8)
    budget.backwards, budget.skips = 10, MIN_SAMPLES - 10
    assert budget.allows_skip()
    budget.skips += 1
    assert not budget.allows_skip()


def test_exactly_at_the_floor_is_affordable() -> None:
    budget = BackwardBudget(0.5)
    budget.backwards = budget.skips = 100
    assert budget.allows_skip()


def test_calibrates_once() -> None:
    budget = BackwardBudget("auto")
    for would_skip in (True, True, True, False):
        budget.observe_warmup(would_skip)
    budget.calibrate()
    assert budget.floor == 1.0 - 0.5 * 0.75
    assert not budget.calibrating


def test_never_calibrates_below_half_or_on_nothing() -> None:
    budget = BackwardBudget("auto")
    budget.calibrate()
    assert budget.floor == 0.5
    assert budget.calibrating
    budget.observe_warmup(True)
    budget.calibrate()
    assert budget.floor == 0.5
    assert not budget.calibrating


def test_one_visit_calibrates() -> None:
    budget = BackwardBudget("auto")
    budget.observe_warmup(False)
    budget.calibrate()
    assert budget.floor == 1.0


def test_a_floor_that_is_found_is_not_sought_again_after_a_load() -> None:
    budget = BackwardBudget("auto")
    budget.observe_warmup(False)
    budget.calibrate()
    again = BackwardBudget("auto")
    again.load_state_dict(budget.state_dict())
    assert not again.calibrating
    assert again.floor == 1.0
