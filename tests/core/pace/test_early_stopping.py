"""How much of refinement a scene needs."""

import json

import pytest

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.early_stopping import CYCLE_ENDS, EarlyStopping, mean_gain, watched_views, why_none_watched
from skipgs_plug.core.pace.needs import refining_share

VIEWS = [f"{i}.png" for i in range(6)]


def follow(losses, tolerance=0.05, iterations=800):
    """Go through all cycles; `losses(view, share done)` is the loss of a view."""
    early_stopping = EarlyStopping(tolerance)
    for i in range(iterations):
        done = i / iterations
        early_stopping.progress(done)
        if early_stopping.ended:
            break
        if early_stopping.watching:
            view = VIEWS[i % len(VIEWS)]
            early_stopping.see(view, losses(view, done))
    return early_stopping, i / iterations


def test_a_scene_that_needs_nothing_ends_after_the_second_cycle():
    early_stopping, done = follow(lambda view, done: 0.1)
    assert early_stopping.early and done == CYCLE_ENDS[1]
    assert early_stopping.gains == [(0.0, 0.0)] and early_stopping.gain_left == 0.0


def test_a_scene_that_gains_to_the_end_gets_all():
    early_stopping, _ = follow(lambda view, done: 0.1 * (1.0 - 0.5 * done))
    assert not early_stopping.ended and early_stopping.cycle == len(CYCLE_ENDS) - 1
    assert len(early_stopping.gains) == 1 and early_stopping.gains[0][0] > 0.05
    early_stopping.progress(1.0)
    assert early_stopping.ended and not early_stopping.early


def test_doubt_counts_for_going_on():
    gains = {view: 0.002 * (i % 2) for i, view in enumerate(VIEWS)}
    early_stopping, done = follow(lambda view, done: 0.1 - gains[view] * (done > 0.125))
    assert early_stopping.gains[0][1] > 0.02 and not early_stopping.ended and done > CYCLE_ENDS[1]


def test_views_that_get_worse_say_nothing():
    early_stopping, _ = follow(lambda view, done: 0.1 * (1.0 + done))
    assert not early_stopping.ended and early_stopping.gains[0][0] < -0.05


def test_progress_runs_from_zero_to_one_in_every_cycle():
    early_stopping = EarlyStopping(0.05)
    seen = [early_stopping.progress(i / 80) for i in range(80)]
    assert seen == pytest.approx([i / 10 for i in range(10)] * 2 + [i / 60 for i in range(60)])


def test_without_two_watched_views_nothing_is_judged():
    early_stopping = EarlyStopping(0.05)
    for i in range(100):
        early_stopping.progress(i / 100)
    assert early_stopping.gains == [] and early_stopping.gain_left is None and not early_stopping.ended


def test_a_saved_state_goes_on():
    def losses(view, done):
        return 0.1 * (1.0 - 0.3 * done) + 0.001 * VIEWS.index(view)

    whole, _ = follow(losses)
    first = EarlyStopping(0.05)
    for i in range(800):
        if i == 150:
            second = EarlyStopping(0.05)
            second.load_state_dict(json.loads(json.dumps(first.state_dict())))
            first = second
        first.progress(i / 800)
        if first.watching:
            first.see(VIEWS[i % len(VIEWS)], losses(VIEWS[i % len(VIEWS)], i / 800))
    assert first.state_dict() == whole.state_dict()


def test_the_share_follows_from_the_visits():
    assert refining_share(15_000, 100) == refining_share(2000, 17) == 0.2
    assert refining_share(3000, 255) == pytest.approx(0.2484, abs=1e-4)
    assert refining_share(1500, 255) == pytest.approx(0.2954, abs=1e-4)
    assert refining_share(2000, 2000) == 0.46
    assert refining_share(1999, 2000) == 1.0


def test_a_short_refinement_needs_more_of_its_iterations():
    assert refining_share(1000, 17) == 0.4
    assert refining_share(500, 17) == 0.8
    assert refining_share(400, 17) == refining_share(20, 17) == 1.0


def test_watched_views_are_few_and_always_the_same():
    names = [f"{i:03}.jpg" for i in range(255)]
    assert watched_views(names, 3750) == watched_views(reversed(names), 3000) and len(watched_views(names, 3000)) == 12
    assert len(watched_views(names[:46], 1000)) == 4 and len(watched_views(names[:31], 1000)) == 3
    assert watched_views(names[:17], 1000) == watched_views(names[:1], 1000) == frozenset()
    # With one iteration less, the first cycle does not show every view.
    assert len(watched_views(names, 8 * 255)) == 12 and not watched_views(names, 8 * 255 - 1)
    assert why_none_watched(255, 8 * 255) is None
    assert "254 iterations is too short to show each of 255" in str(why_none_watched(255, 8 * 255 - 1))


def test_gain_in_decibels():
    assert mean_gain({"a": 0.1, "b": 0.1}, {"a": 0.01, "b": 0.01, "c": 1.0}) == pytest.approx((20.0, 0.0))
    assert mean_gain({"a": 0.1}, {"a": 0.1}) is None
    # gains of 0, 20 and 40 dB: the deviation is 20, the standard error 20 / sqrt(3)
    before, after = dict.fromkeys("abc", 0.1), {"a": 0.1, "b": 0.01, "c": 0.001}
    assert mean_gain(before, after) == pytest.approx((20.0, 20.0 / 3**0.5))


def test_a_state_of_other_cycles_is_refused():
    state = EarlyStopping(0.05).state_dict()
    for damage in ({"ends": [0.5, 1.0]}, {"cycle": -1}, {"cycle": 3}):
        with pytest.raises(SkipGSError, match=r"which no run has; start the gate afresh"):
            EarlyStopping(0.05).load_state_dict({**state, **damage})
    again = EarlyStopping(0.05)
    again.load_state_dict({**state, "cycle": 0})
    assert again.cycle == 0


def test_views_without_loss_have_a_gain() -> None:
    """Views of background alone."""
    assert mean_gain({"a": 0.0, "b": 0.0}, {"a": 0.0, "b": 0.0}) == (0.0, 0.0)
    assert mean_gain({"a": 0.1, "b": 0.1}, {"a": 0.0, "b": 0.0}) == pytest.approx((80.0, 0.0))
