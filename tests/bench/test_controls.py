from __future__ import annotations

import itertools
import random

from hypothesis import given
from hypothesis import strategies as st

from skipgs_plug.bench.controls import PlannedSkipping, periodic_skipping, random_skipping


@st.composite
def plans(draw: st.DrawFn) -> tuple[int, int, int]:
    first = draw(st.integers(0, 1000))
    n = draw(st.integers(1, 300))
    return first, first + n, draw(st.integers(0, n))


def decided(policy: PlannedSkipping, first: int, end: int) -> list[bool]:
    return [policy.decide("a", 1.0, step).skip for step in range(first, end)]


@given(plans(), st.integers(0, 5))
def test_random_skips_exactly_as_often_as_told(plan, seed):
    first, end, n_skips = plan
    assert sum(decided(random_skipping(first, end, n_skips, seed), first, end)) == n_skips


@given(plans())
def test_periodic_skips_exactly_as_often_as_told_and_evenly(plan):
    first, end, n_skips = plan
    skips = decided(periodic_skipping(first, end, n_skips), first, end)
    assert sum(skips) == n_skips
    steps = [i for i, skip in enumerate(skips) if skip]
    gaps = {b - a for a, b in itertools.pairwise(steps)}
    assert not gaps or max(gaps) - min(gaps) <= 1


@given(plans())
def test_no_control_skips_in_warm_up(plan):
    first, end, n_skips = plan
    for policy in (random_skipping(first, end, n_skips, 0), periodic_skipping(first, end, n_skips)):
        answers = [policy.decide("a", 1.0, step) for step in range(max(0, first - 10), first)]
        assert all(answer == (False, "warm-up") for answer in answers)


def test_random_has_its_own_generator():
    random.seed(3)
    before = random.getstate()
    first = random_skipping(0, 100, 40, seed=7)
    assert random.getstate() == before
    assert random_skipping(0, 100, 40, seed=7).skips == first.skips
    assert random_skipping(0, 100, 40, seed=8).skips != first.skips


def test_a_plan_travels_in_its_state():
    saved = periodic_skipping(10, 50, 13)
    restored = PlannedSkipping(0, 1, ())
    restored.load_state_dict(saved.state_dict())
    assert decided(restored, 0, 60) == decided(saved, 0, 60)
