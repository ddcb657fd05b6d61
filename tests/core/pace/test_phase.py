"""A phase that runs whole, and the end of one phase at the beginning of the following one."""

from __future__ import annotations

import pytest

from skipgs_plug import SkipConfig
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER, Phase, PhasePlan
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.pace.refining import Refining

LAST = 10_000


class Before(Phase):
    """A phase in which half of 10 iterations were left out, and which counts its ends."""

    stretch = 1.5

    def __init__(self) -> None:
        self.ends = 0

    def shortened(self, end: int) -> int:
        return end

    def end(self) -> None:
        self.ends += 1


def plan(before: Phase, named: frozenset[int] = frozenset()) -> PhasePlan:
    """Facts about refinement from iteration 10 to the last one."""
    return PhasePlan(range(10, LAST + 1), {"step == 3": set()}, set(named), LAST, before, ["a", "b"], 2, None, False)


def refining(before: Phase, state: dict[str, object] | None = None, **settings: object) -> Refining:
    phase = Refining(SkipConfig(compensate=False, **settings), ScaledRates())  # type: ignore[arg-type]
    if state is not None:
        phase.load_state_dict(state)
    assert phase.begin(plan(before))
    return phase


def test_a_phase_that_runs_whole_needs_no_facts_and_has_no_state() -> None:
    phase = Phase()
    assert not phase.leaves_out and phase.numbers(3, 10) == range(0)
    assert phase.begin(plan(Phase())) and all(phase.runs(number) for number in range(10))
    assert (phase.share, phase.stretch, phase.shortened(10)) == (1.0, 1.0, 0)
    assert phase.report() is None and phase.state_dict() is None


def test_refinement_ends_the_phase_before_it_once() -> None:
    before = Before()
    phase = refining(before, refine_share=0.5)
    assert before.ends == 0
    for number in range(10, 14):
        phase.runs(number)
    assert before.ends == 1
    resumed = Before()
    other = refining(resumed, phase.state_dict(), refine_share=0.5)
    assert [other.runs(n) for n in range(14, 60)] == [phase.runs(n) for n in range(14, 60)]
    assert resumed.ends == 0


def test_a_share_that_is_given_is_not_stretched() -> None:
    given, auto = refining(Before(), refine_share=0.25), refining(Before(), refine_share="auto")
    assert auto.share == pytest.approx(0.12)
    given.runs(10)
    auto.runs(10)
    assert given.share == 0.25 and auto.share == pytest.approx(1.5 * 0.12)


def test_reasons_of_iterations_that_must_run() -> None:
    phase = Refining(SkipConfig(refine_share=0.25), ScaledRates())
    phase.begin(plan(Phase(), frozenset({12})))
    assert phase.always == {NAMED_FOR_TRAINER: {12}}  # a condition that never holds is not listed
