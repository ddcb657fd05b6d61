"""Which iterations run."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skipgs_plug.core.pace.sampling import Sampling


def ran(share: float, numbers: range, must: frozenset[int] = frozenset()) -> list[int]:
    sampling = Sampling(share)
    return [n for n in numbers if sampling.runs(n in must)]


@settings(deadline=None)
@given(st.floats(0.05, 1.0), st.integers(0, 40_000), st.integers(1, 3000))
def test_the_share_is_kept_everywhere(share: float, first: int, count: int) -> None:
    chosen = ran(share, range(first, first + count))
    for end in range(first, first + count, max(count // 7, 1)):
        assert abs(sum(n < end for n in chosen) - share * (end - first)) <= 2.0


@settings(deadline=None)
@given(st.floats(0.05, 0.9), st.sets(st.integers(0, 999), max_size=40))
def test_what_must_run_runs_and_is_paid_for(share: float, must: set[int]) -> None:
    chosen = ran(share, range(1000), frozenset(must))
    assert must <= set(chosen)
    assert len(chosen) <= max(share * 1000, len(must)) + len(must) / 2 + 2


def test_more_that_must_run_than_may_all_run() -> None:
    must = frozenset(range(0, 1000, 2))
    assert set(ran(0.25, range(1000), must)) == must


def test_a_share_of_one_leaves_out_nothing() -> None:
    assert ran(1.0, range(5000)) == list(range(5000))


@pytest.mark.parametrize("n_views", [2, 5, 10, 17, 20, 25, 50])
@pytest.mark.parametrize("share", [0.2, 0.25, 0.4, 0.5])
def test_no_view_starves_in_a_loop_that_takes_them_in_turn(share: float, n_views: int) -> None:
    rounds = 200
    chosen = ran(share, range(rounds * n_views))
    visits = [sum(n % n_views == view for n in chosen) for view in range(n_views)]
    assert min(visits) >= 0.6 * share * rounds


@settings(deadline=None)
@given(st.lists(st.tuples(st.floats(0.05, 1.0), st.integers(50, 400)), min_size=1, max_size=6))
def test_a_share_that_turns_is_kept_from_then_on(parts: list[tuple[float, int]]) -> None:
    sampling = Sampling(1.0)
    for share, count in parts:
        sampling.set_share(share)
        before = sampling.run
        for _ in range(count):
            sampling.runs(False)
        assert abs(sampling.run - before - share * count) <= 2.0


def test_a_saved_state_goes_on() -> None:
    whole = ran(0.37, range(500))
    first = Sampling(0.37)
    begun = [n for n in range(300) if first.runs(False)]
    second = Sampling(1.0)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert begun + [n for n in range(300, 500) if second.runs(False)] == whole
    assert (second.run, second.left_out) == (len(whole), 500 - len(whole))
