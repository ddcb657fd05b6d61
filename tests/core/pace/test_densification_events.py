"""The densification events that run when iterations before them are left out."""

import itertools

import pytest

from skipgs_plug.core.pace.densification_events import DensificationEvents
from skipgs_plug.core.trainer_info import Densification


def kept(needs, visible, every, numbers=range(100, 2001, 100), share=0.1, length=100_000):
    """Return the events that run if every `every`-th iteration runs, and each event that has enough before it."""
    events = DensificationEvents(numbers, Densification(needs=needs))
    found = []
    for number in range(numbers[-1] + 1):
        if number in events:
            needed = events.needed(number, visible, share, length)
            if events.behind >= needed:
                found.append(number)
                events.ran(number, needed)
            else:
                events.skipped()
        elif number % every == 0:
            events.ran(number)
    return found


def test_needs_of_an_event():
    assert kept("nothing", 0.3, 10) == list(range(100, 2001, 100))
    assert kept("visits", 1.0, 1) == list(range(100, 2001, 100))
    assert kept("visits", 0.3, 5)[:2] == [300, 500]  # 55 * 0.7 ** 0.4 = 47.7 are needed; the third event uses surplus
    # Where a view shows all Gaussians, a tenth of the iterations keeps each event.
    assert kept("visits", 0.999, 10)[:3] == [100, 200, 300]
    assert kept("visits", 0.95, 20)[:2] == [400, 800]  # 16 iterations are needed, and 4 run per event
    assert kept("iterations", 0.95, 5)[:2] == [600, 1200]
    # At least 16 events are kept, or all if there are fewer.
    assert len(kept("visits", 0.3, 10, range(100, 1301, 100), length=1300)) == 13
    assert kept("visits", 0.3, 5, length=4000)[:2] == [200, 300]  # 25 needed; 20 and 40 ran


def test_a_larger_share_asks_for_more_iterations_per_event_unless_the_scene_grows_strongly():
    events = DensificationEvents(range(100, 1001, 100), Densification())
    assert events.needed(200, 0.7, 0.1, 100_000) == 33  # 55 * 0.3 ** 0.4
    assert events.needed(200, 0.7, 0.4, 100_000) == 47  # times 4 ** (0.7 ** 2 / 2)
    assert events.needed(200, 0.7, 0.4, 100_000, grows_strongly=True) == 33


def test_growth_is_that_of_the_last_event():
    events = DensificationEvents(range(100, 1001, 100), Densification())
    events.rows = 1000
    assert events.growth == 0.0  # no event yet
    events.ran(100)
    events.rows = 1060
    assert events.grown == 60 and events.growth == pytest.approx(0.06)
    events.ran(150)  # no event
    assert events.grown == 60
    events.rows = 900  # a prune removed more than the event added
    assert events.grown == 0 and events.growth == 0.0


LONG = range(100, 6001, 100)  # 60 events, with 20 iterations for each if every fifth runs


def test_events_wait_longer_the_fewer_gaussians_a_view_shows():
    assert kept("visits", 1.0, 10, LONG) == list(LONG)
    shares = [len(kept("visits", visible, 5, LONG)) / 60 for visible in (0.3, 0.5, 0.75, 0.9, 0.999)]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    # 55 * 0.25 ** 0.4 = 31.6 iterations per event, of which 20 run between two events of the trainer
    assert shares[2] == pytest.approx(20 / 31.6, abs=0.03)


def test_events_need_more_iterations_if_a_larger_share_of_them_runs():
    # 31.6 iterations with a share of 0.1, and 8 ** (0.75**2 / 2) times as many with 0.8.
    assert len(kept("visits", 0.75, 5, LONG)) == pytest.approx(60 * 20 / 31.6, abs=2)
    assert len(kept("visits", 0.75, 5, LONG, share=0.8)) == pytest.approx(60 * 20 / 56.7, abs=2)
    # Where a view shows a third of the Gaussians, events hardly need more.
    few = len(kept("visits", 1 / 3, 5, LONG))
    assert few - 3 <= len(kept("visits", 1 / 3, 5, LONG, share=0.8)) <= few


def test_surplus_iterations_count_for_the_following_event_alone():
    gaps = {after - before for before, after in itertools.pairwise(kept("visits", 0.75, 5, LONG))}
    assert gaps == {100, 200}  # without surplus, only every second event would run
    events = DensificationEvents(range(100, 1001, 100), Densification())
    for number in range(1, 400):
        events.ran(number) if number % 100 else events.skipped()
    needed = events.needed(400, 0.75, 0.1, 1_000_000)
    assert needed == 31 and events.behind > 10 * needed
    events.ran(400, needed)
    assert events.state_dict()["behind"] <= 32  # the surplus of one event is bounded
    resumed = DensificationEvents(range(100, 1001, 100), Densification())
    resumed.load_state_dict(events.state_dict())
    assert resumed.state_dict() == events.state_dict()


@pytest.mark.parametrize(
    "settings, found, stop, expected",
    [
        ({"reset_marks": ("opacity_reset_interval",)}, False, 1101, False),
        ({"reset_marks": ("opacity_reset_interval",)}, True, 1101, True),
        ({"reset_numbers": lambda numbers: []}, False, 1101, False),
        ({}, False, 1101, True),  # it is not known
        ({"resets": False}, False, 1101, False),
        ({"reset_marks": ("opacity_reset_interval",), "clears_moments": True}, False, 1101, True),
        ({"reset_marks": ("opacity_reset_interval",)}, False, 1501, True),  # a selection follows
    ],
)
def test_steps_are_as_with_resets_unless_none_is_known_to_come(settings, found, stop, expected):
    events = DensificationEvents(range(100, 1001, 100), Densification(**settings))
    assert events.with_resets(found, stop) is expected
