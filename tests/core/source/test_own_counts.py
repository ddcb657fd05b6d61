"""What a loop counts or moves by itself cannot be foreseen: warned of, unless it only gathers."""

import re
from collections import deque
from types import SimpleNamespace

import pytest
import torch
from read_milestones import found


def test_what_the_loop_counts_by_itself_is_warned_of():
    def counting(stop):
        images = 0
        for step in stop():
            if step == 70:
                print("by the number")
            images += 4
            if not images % 20:
                print("save")

    def attribute(stop):
        run = SimpleNamespace(done=0)
        for _step in stop(run=run):
            run.done += 1
            if run.done in (10, 20):
                print("save")

    for loop, condition in ((counting, "images % 20"), (attribute, "run.done in (10, 20)")):
        with pytest.warns(RuntimeWarning, match=rf"Line \d+ of .*\({re.escape(condition)}\) counts the iterations"):
            found(loop)


def test_a_count_that_the_loop_sets_back_is_warned_of_where_it_decides_about_something_else():
    """PUP 3D-GS raises SH bands by a count of its own, which begins anew at each prune."""

    def loop(stop):
        first, since, other, last = 1, 1, 0, 30
        for step in stop(first=first, last=last):
            if since % 10 == 0:
                print("SH")
            if since == last:
                print("begin anew")
                since = first
            else:
                since += 1
            other += 1
            if step == 70:
                other = 0
            if other == 20:
                print("save")

    with pytest.warns(RuntimeWarning, match="counts the iterations that run") as said:
        assert found(loop) == {"step == 70": [70]}
    assert [str(one.message).partition("(")[2].partition(")")[0] for one in said] == [
        "since % 10 == 0",
        "since == last",
        "other == 20",
    ]

    def saving(stop):
        since, left = 0, 30
        for _step in stop():
            since += 1
            if since >= 50:
                print("save")
                since = 0
            left -= 1
            if left == 0:
                print("save")
                left = 30

    with pytest.warns(RuntimeWarning, match="counts the iterations that run") as said:
        assert found(saving) == {}
    assert [str(one.message).partition("(")[2].partition(")")[0] for one in said] == ["since >= 50", "left == 0"]


def test_a_number_that_is_kept_in_an_entry_of_a_table_is_the_number():
    def loop(stop):
        state = {"step": 0, "loss": 0.0}
        for step in stop(state=state):
            state["step"] = step
            if state["step"] % 40 == 0:
                print("save")

    assert found(loop) == {"step % 40 == 0": [80]}


def test_a_queue_that_a_condition_empties_is_warned_of():
    def loop(stop):
        saves = deque([70, 80])
        for step in stop(saves=saves):
            while saves and step >= saves[0]:
                saves.popleft()

    with pytest.warns(RuntimeWarning, match=r"\(step >= saves\[0\]\) moves its own limit"):
        assert found(loop) == {}


def test_a_limit_that_a_condition_moves_is_warned_of():
    def loop(stop):
        due, saves, best = 60, [70, 80], 1.0
        for step in stop(due=due, saves=saves, best=best):
            if step >= due:
                due += 20
            if saves and saves[0] <= step:
                saves.pop(0)
            if step > 55 and best > 0.5:
                best = 1 / step

    with pytest.warns(RuntimeWarning, match="moves its own limit") as said:
        assert found(loop) == {}
    assert [str(one.message).partition("(")[2].partition(")")[0] for one in said] == ["step >= due", "saves[0] <= step"]


def test_gathering_over_a_few_iterations_is_nothing_to_warn_of():
    def loop(stop):
        gathered, images, optimizer = 0, 0, torch.optim.Adam([torch.zeros(1)])
        for step in stop(optimizer=optimizer):
            gathered += 1
            if gathered == 4:  # counts the iterations that run
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
                gathered = 0
            if step % 2 == 0:
                images += 1
            if images > 10 and images:
                print("a stretch")

    assert found(loop) == {"step % 2 == 0": list(range(50, 100, 2))}
