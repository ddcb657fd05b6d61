"""Shares and factors that "auto" chooses."""

import math

import pytest

from skipgs_plug.core.pace.needs import (
    for_new_gaussians,
    geometry_part,
    growing_factor,
    growing_share,
    most_raised,
    opacity_factor,
    refining_share,
    share_after_reset,
    share_factor,
)


def test_new_gaussians_ask_for_more_iterations():
    assert share_factor(0.0) == share_factor(0.015) == 1.0 and share_factor(0.045) == pytest.approx(3.0)
    assert for_new_gaussians(None) == for_new_gaussians(0.2) == for_new_gaussians(2.718) == 1.0
    assert for_new_gaussians(97 / 3) == pytest.approx(1.82, abs=0.01)


def test_a_late_reset_asks_for_500_iterations():
    assert share_after_reset(500) == share_after_reset(1) == 1.0 and share_after_reset(1000) == 0.5
    assert share_after_reset(3000) == 0.0  # there are enough of them in any case


def test_new_gaussians_ask_for_two_fifths_at_most_and_for_more_where_positions_slow_down_too_late():
    assert most_raised(3500, 2.0, slow_positions=False) == most_raised(1500, 2.0, slow_positions=True) == 0.4
    assert most_raised(3500, 1.25, slow_positions=True) == pytest.approx(0.5)
    assert most_raised(3500, 2.0, slow_positions=True) == pytest.approx(0.4 * (3500 / 1500) ** 0.35)


def test_shares_that_auto_chooses():
    assert growing_share(15_000, 255, longer=True) == growing_share(15_000, 255, longer=False) == 0.1
    assert growing_share(15_000, 1000, longer=True) == growing_share(15_000, 1000, longer=False) == pytest.approx(1 / 3)
    assert growing_share(1500, 17, longer=True) == 0.4
    assert growing_share(3500, 255, longer=True) == 5 * 255 / 3500
    assert growing_share(3500, 255, longer=True, resets=False) == 4 * 255 / 3500  # steps are longer there
    assert growing_share(3500, 255, longer=False, resets=False) == 5 * 255 / 3500
    assert growing_share(1500, 17, longer=False) == 0.8
    # Longer schedules run more iterations, but a smaller share of them.
    assert growing_share(3000, 46, longer=True) == pytest.approx(765 / 3000, abs=1e-3)
    assert growing_share(6000, 46, longer=True) == pytest.approx(975 / 6000, abs=1e-3)
    assert refining_share(3000, 17, grown=3000) == pytest.approx(701 / 3000, abs=1e-3)
    # Where all events run, each needs 14 iterations, but all together at most 1,200.
    assert growing_share(2500, 17, longer=True, events=10) == pytest.approx(717.5 / 2500, abs=1e-4)
    assert growing_share(2500, 17, longer=True, events=58) == 14 * 58 / 2500
    assert growing_share(2500, 17, longer=True, events=97) == growing_share(2500, 17, longer=False) == 1200 / 2500
    assert growing_share(500, 17, longer=True) == growing_share(0, 17, longer=True) == 1.0
    assert refining_share(3500, 255) < refining_share(3500, 255, grown=3500) == pytest.approx(0.3897, abs=1e-4)
    assert refining_share(1000, 17) == 0.4 and refining_share(1000, 17, grown=1000) == 0.55
    assert refining_share(3500, 255, 3500, slow_positions=True) == pytest.approx(7 * 255 / 3500)
    assert refining_share(15_000, 255, 15_000, slow_positions=True) == refining_share(15_000, 255, 15_000)
    assert refining_share(3500, 43, 3500, slow_positions=True) == 0.35 > refining_share(3500, 43, 3500)
    assert refining_share(1500, 17, 1500, slow_positions=True) == refining_share(1500, 17, 1500)
    assert refining_share(500, 17, grown=500) == 0.8
    # The share falls with the fourth root of the visits, up to 24 visits of each view, and is at most 40 %.
    assert refining_share(15_000, 255, grown=15_000) == pytest.approx(0.2708, abs=1e-4)
    assert refining_share(15_000, 100, grown=15_000) == 24 * 100 / 15_000
    assert refining_share(3000, 255, grown=3000) == refining_share(15_000, 2000, grown=15_000) == 0.4
    assert refining_share(60_000, 255, grown=60_000) == 0.12
    assert refining_share(15_000, 17, grown=15_000) == 0.12 < refining_share(15_000, 17) == 0.2
    # Refinement of a sixth of the schedule runs as many iterations as one of a half, but never all of its own.
    assert 5000 * refining_share(5000, 100, grown=25_000) == pytest.approx(15_000 * refining_share(15_000, 100, 15_000))
    assert refining_share(5000, 100, grown=5000) < refining_share(5000, 100, grown=25_000)
    assert refining_share(500, 17, grown=2500) == refining_share(300, 255, grown=2700) == 0.8


def test_factors_while_the_scene_grows():
    assert growing_factor(1500, 0.4, None) == growing_factor(1500, 1.0, 0.96) == 1.0
    assert growing_factor(1500, 0.25, 0.96) == 3.0  # the longest that pay
    assert growing_factor(1500, 0.25, 0.96, by_budget=True) == 4.0  # the number of Gaussians does not rise with them
    assert growing_factor(700, 0.9, 1 / 3) == pytest.approx(1 / 0.9)  # steps conserve the path, and are not longer
    assert growing_factor(15_000, 0.12, 0.96) == pytest.approx((2100 / 1800) ** 2)
    assert growing_factor(15_000, 0.2, 0.96) == growing_factor(15_000, 0.2, 0.96, times_grown=math.e) == 1.0
    assert growing_factor(15_000, 0.2, 0.96, times_grown=math.e**1.5) == pytest.approx((1.5 * 2100 / 3000) ** 2)
    assert growing_factor(15_000, 0.2, 0.96, times_grown=12.0) == pytest.approx((2 * 2100 / 3000) ** 2)
    assert opacity_factor(0.25) == 2.0 and opacity_factor(1.0) == 1.0
    assert geometry_part(3.0, 4.0) == pytest.approx(4 / 3)
    assert geometry_part(1.5, 4.0) == geometry_part(3.0, 8.0) == 2.0 and geometry_part(5.0, 4.0) == 1.0
