"""Facts about a trainer and its loop, from which the phases of a run plan their iterations."""

from __future__ import annotations

import dataclasses
import json

from skipgs_plug.core.pace.loop_facts import LoopFacts
from skipgs_plug.core.pace.phase import Phase
from skipgs_plug.core.trainer_info import TrainerInfo

FACTS = TrainerInfo(
    500, max_steps=1000, epoch=6, accumulates=True, steps_each=True, slow_positions=True, positions_rate=0.5
)


def test_a_resumed_run_plans_by_the_facts_of_the_first_one() -> None:
    """A trainer tells its facts after its loop has begun, and a resumed loop is planned before that."""
    facts, resumed = LoopFacts(None), LoopFacts(None)
    facts.configure(500, FACTS, ["a", "b", "c"])
    resumed.load_state_dict(json.loads(json.dumps(facts.state_dict())), configured=False)
    told, known = (one.plan(range(500, 1001), {}, 1000, Phase()) for one in (facts, resumed))
    assert known._replace(before=told.before) == told
    assert (known.views, known.epoch, known.slow_positions) == (["a", "b", "c"], 6, True)
    assert (resumed.start, resumed.last) == (500, 1000)
    resumed.configure(500, dataclasses.replace(FACTS, positions_rate=0.1), ["a", "b", "c"])  # it has fallen since
    assert resumed.plan(range(500, 1001), {}, 1000, Phase()).positions_rate == 0.5
