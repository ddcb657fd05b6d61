"""Prunes when refinement has ended, or nearly: a share of the iterations after each runs, and all after the last."""

import json

import pytest
import torch

from skipgs_plug import SkipGate
from skipgs_plug.core.report import write_report

SHARE = 0.2


def train(last, prunes, views=4, share=SHARE, always=(), **settings):
    """Return the gate and the numbers that ran."""
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=0.01)
    gate = SkipGate(start_iter=0, refine_share=share, **settings)
    ran = []
    for step in gate.iterations(range(last + 1), always=[*prunes, *always], views=[f"{n}.png" for n in range(views)]):
        gate.backward((weight - 1).square().mean(), view=f"{step % views}.png", step=step)
        gate.step(optimizer)
        ran.append(step)
        if step in prunes:
            gate.notify_event("prune", step)
            gate.notify_event("optimizer", step)  # one change can be reported in two ways
    gate.detach()
    return gate, ran


def test_each_prune_is_followed_by_its_share_of_the_way_to_the_next():
    prunes = range(500, 2000, 300)
    gate, ran = train(2000, prunes)
    for prune in prunes[1:-1]:
        after = [step for step in ran if prune < step < prune + 300]
        assert after == list(range(prune + 1, prune + 61))  # a fifth of 300
    assert [step for step in ran if step > 1700] == list(range(1701, 2001))  # no further change is expected
    # At the first change, the distance to the second one is not known.
    assert len([step for step in ran if 500 < step < 800]) == 299
    stats = gate.stats()
    assert stats["ran_for"]["share"] == 401 == len([step for step in ran if step < 500])
    assert stats["ran_for"]["changes"] == 300 + 60 * 3 + 300
    assert sum(stats["ran_for"].values()) == stats["iterations_run"] == len(ran)


def test_a_long_schedule_and_many_views_bound_it():
    _, ran = train(8000, [5000])
    assert [step for step in ran if step > 5000] == [*range(5001, 5501), 8000]
    _, ran = train(1000, [600, 700, 800], views=60)
    assert [step for step in ran if 700 < step < 800] == list(range(701, 761))  # one visit of each view


def test_where_no_other_comes_as_expected_the_model_recovers_then():
    _, ran = train(2000, [500, 600, 700])
    assert [step for step in ran if step > 700] == [*range(701, 721), *range(801, 1301), 2000]
    _, ran = train(4000, [1000, 2000, 2700], views=600)  # one visit of each view, before and after it
    assert [step for step in ran if step > 2700] == [*range(2701, 3301), *range(3401, 4001)]


def test_a_prune_in_the_second_half_of_the_steps_is_recovered_from_at_the_end():
    gate, ran = train(2000, [350])
    assert ran == [*range(401), *range(1551, 2001)]  # 50 steps were left, and 500 are wanted
    assert gate.stats()["ran_for"] == {"share": 401, "conditions": 0, "changes": 450}
    _, ran = train(2000, [350, 1400])  # the iterations after the second prune are enough for both
    assert ran == [*range(401), *range(1400, 1901), 2000]
    _, ran = train(8000, [1590], views=600)  # 10 were left, and 600 are wanted
    assert ran == [*range(1601), *range(7411, 8001)]
    _, ran = train(2000, [150])
    assert ran == [*range(401), 2000]
    _, ran = train(2000, [350], pause_iters=30)  # 50 steps are enough
    assert ran == [*range(401), 2000]


def test_prunes_that_repeat_before_and_after_the_end_get_their_share_each():
    _, ran = train(2000, range(100, 2000, 100))
    assert ran[: ran.index(420) + 1] == list(range(421))  # 20 after the prune in iteration 400, the last step
    assert [step for step in ran if 420 < step <= 520] == list(range(500, 521))


def test_pause_iters_is_taken_as_it_is():
    _, ran = train(1000, [600, 800], pause_iters=7)
    assert [step for step in ran if step > 600] == [*range(601, 608), 800, *range(801, 808), 1000]


def test_the_summary_and_skipgs_json_say_why_more_than_the_share_ran(tmp_path):
    gate, ran = train(1000, [500, 700, 900], always=range(300, 1000, 50))
    write_report(gate, tmp_path / "skipgs.json")
    why = json.loads((tmp_path / "skipgs.json").read_text())["ran_for"]
    assert sum(why.values()) == len(ran) and why["changes"] == 200 + 40 + 100 and why["conditions"] > 5
    line = next(line for line in gate.summary().splitlines() if "more than the share" in line)
    for number in why.values():
        assert f"{number:,} " in line
    assert "6 changes in all" in line


@pytest.mark.parametrize(("stop", "prunes"), [(560, (500, 700, 900)), (720, (500, 700, 900)), (190, (170, 600))])
def test_a_resumed_run_counts_on(stop, prunes):
    weight = torch.nn.Parameter(torch.zeros(1))
    optimizer = torch.optim.SGD([weight], lr=0.01)

    def part(gate, first, end):
        for step in gate.iterations(range(first, 1001), always=prunes):
            gate.backward((weight - 1).square().mean(), view=step % 4, step=step)
            gate.step(optimizer)
            ran.append(step)
            if step in prunes:
                gate.notify_event("prune", step)
            if step == end:
                return json.loads(json.dumps(gate.state_dict()))
        return None

    ran = []
    whole = SkipGate(start_iter=0, refine_share=SHARE)
    part(whole, 0, 1000)
    whole.detach()
    expected, ran = ran, []
    first = SkipGate(start_iter=0, refine_share=SHARE)
    state = part(first, 0, stop)
    first.detach()
    second = SkipGate(start_iter=0, refine_share=SHARE)
    second.load_state_dict(state)
    part(second, ran[-1] + 1, 1000)
    second.detach()
    assert ran == expected and second.stats()["ran_for"] == whole.stats()["ran_for"]
