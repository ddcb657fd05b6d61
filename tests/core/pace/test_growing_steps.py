"""How kinds of parameters share in longer steps while the scene grows."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from skipgs_plug.core.pace.growing_steps import longer_steps
from skipgs_plug.core.pace.needs import LONGEST_STEPS_OF_POSITIONS, LONGEST_STEPS_OF_POSITIONS_THAT_STAY


def positions(times_grown: float | None, unrefined: bool) -> float:
    """Return the factor on the rate of positions in a schedule with opacity resets."""
    events: Any = SimpleNamespace(all_run=False, resets=True, clears_moments=False)
    facts = {"events": events, "length": 7000, "reset": 6000, "resets": True, "opacities_recover": True}
    more = {"unrefined": unrefined, "steps_after": 0, "random_points": False}
    plan: Any = SimpleNamespace(**facts, **more)
    factor, parts = longer_steps(plan, 0.14, 0.5, times_grown, fading=False)
    return factor * parts.positions


@pytest.mark.parametrize("times_grown", [None, 1.0, math.e])
def test_positions_go_far_where_a_run_without_refinement_hardly_grows(times_grown: float | None) -> None:
    assert positions(times_grown, unrefined=True) == pytest.approx(LONGEST_STEPS_OF_POSITIONS)


def test_positions_stay_nearer_where_such_a_run_has_grown_strongly() -> None:
    assert positions(2.8, unrefined=True) == pytest.approx(LONGEST_STEPS_OF_POSITIONS_THAT_STAY)
    assert positions(2.8, unrefined=False) == pytest.approx(positions(1.0, unrefined=False))
