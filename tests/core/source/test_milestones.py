"""Milestones read from a loop's source: iterations that must run."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from read_milestones import found

from skipgs_plug import SkipGSError


def report(step, saves):
    """Stand for a function that a loop calls with its number."""


def test_conditions_on_the_number():
    def loop(stop):
        opt = SimpleNamespace(every=20, until=70)
        saves = [60, 99, 1000]
        for step in stop(opt=opt, saves=saves):
            if step % 25 == 0:
                print("SH")
            if step in saves or step == 51:
                print("save")
            if step > opt.until and step % opt.every == 0:
                print("prune")
            elif step < 10 and step % 3 == 0:
                print("never in these")
            if step >= 10:
                print("a stretch of them")
            flag = "now" if step == 77 else "not now"
            print(flag)
            if not step % 40:
                print("remainder as a truth")

    assert found(loop) == {
        "step % 25 == 0": [50, 75],
        "step in saves or step == 51": [51, 60, 99],
        "step > opt.until and step % opt.every == 0": [80],
        "step == 77": [77],
        "not step % 40": [80],
    }


def test_the_rarer_side_of_a_condition_counts():
    def loop(stop):
        last = 99
        for step in stop(last=last):
            if step != last:
                print("all but one")

    assert found(loop) == {"step != last": [99]}


def test_what_cannot_be_known_but_the_number_may_hold():
    def loop(stop):
        for step in stop():
            size = len(hex(step))
            if size > 1 and step % 30 == 0:
                print("depends on the model too")

    assert found(loop) == {"size > 1 and step % 30 == 0": [60, 90]}


def test_nested_conditions_hold_together():
    def loop(stop):
        mode = "save"
        for step in stop(mode=mode):
            if step < 60:
                if step % 10 == 0:
                    print("densify")
            else:
                with open("/dev/null") as _:
                    while step % 45 == 0:
                        break
            match mode:
                case "save":
                    if step == 95:
                        print("save")

    assert found(loop) == {"step % 10 == 0": [50], "step % 45 == 0": [90], "step == 95": [95]}


def test_names_that_stand_for_the_number():
    def loop(stop):
        views = list(range(17))
        for step in stop(views=views):
            position = step % len(views)
            if position == 0:
                print("next round")

    assert found(loop) == {"step % len(views) == 0": [51, 68, 85]}


def test_cases_of_the_number():
    def loop(stop):
        for step in stop():
            match step % 40:
                case 0 | 13 if step:
                    print("save")
                case _:
                    print("as ever")

    assert found(loop) == {"step % 40 == 0": [80], "step % 40 == 13": [53, 93]}


def test_cases_of_a_tuple():
    def loop(stop):
        rank = 0
        for step in stop(rank=rank):
            match rank, step % 40:
                case 0, 13:
                    print("save")
                case _, n if n == 20:
                    print("evaluate")

    assert found(loop) == {"step % 40 == 13": [53, 93], "step % 40 == 20": [60]}


def test_guards_of_cases():
    def loop(stop):
        for step in stop():
            match step:
                case n if n % 45 == 0:
                    print("save")
                case _:
                    print("as ever")

    assert found(loop) == {"step % 45 == 0": [90]}


def test_conditions_without_an_if():
    def loop(stop):
        for step in stop():
            step % 45 or print("save")
            step == 77 and print("evaluate")
            [print(one) for one in (60, 99) if one == step]

    assert found(loop) == {
        "step % 45": [90],
        "step == 77": [77],
        "any((one == step for one in (60, 99)))": [60, 99],
    }


def test_every_way_to_give_a_name_to_the_number():
    def loop(stop):
        for i in stop():
            with open("/dev/null") as _:
                step = i + 1
                rest: int = step % 30
                epoch, place = step // 45, step % 45
                turn, view = divmod(i, 47)
            if view == 0:
                print("of a division", turn)
            if (left := i % 49) == 0 or left > 60:
                print("in a condition")
            if rest == 0:
                print("of a name with a type, which stands for another name")
            if place == 0:
                print("of several at once", epoch)

    assert found(loop) == {
        "i % 47 == 0": [94],
        "i % 49 == 0 or i % 49 > 60": [98],
        "(i + 1) % 30 == 0": [59, 89],
        "(i + 1) % 45 == 0": [89],
    }


def test_a_name_that_is_given_below_is_of_the_iteration_before():
    def loop(stop):
        before = 0
        for step in stop(before=before):
            if step - before == 10:
                print("save")
            before = step

    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step - before == 10\)"):
        found(loop)


def test_a_number_that_the_loop_changes_is_refused():
    def loop(stop):
        for step in stop():
            print([step * 2 for step in range(3)])  # another one
            step += 1
            if step % 25 == 0:
                print("save")

    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step % 25 == 0\)"):
        found(loop)


def test_lists_of_iterations_that_are_handed_on_with_the_number():
    def loop(stop):
        saves, sizes = [7, 70], [1.5, 60]
        tests, rest, own = list(np.array([7, 80])), range(40, 100, 25), range(50, 100)
        for step in stop(saves=saves, sizes=sizes, tests=tests, rest=rest, own=own):
            report(step, saves)
            report(step, saves=sizes)
            report(step, tests)
            report(step, rest)
            report(step, own)

    assert found(loop) == {"saves": [70], "tests": [80], "rest": [65, 90]}


def test_functions_that_only_look_at_numbers():
    made = {}
    exec("def is_due(step, every): return step % every == 0", made)  # its source cannot be read

    def loop(stop):
        is_due = made["is_due"]
        for step in stop(is_due=is_due):
            if is_due(step, 45):
                print("log")

    assert found(loop, pure=["is_due"]) == {"is_due(step, 45)": [90]}
    with pytest.raises(SkipGSError, match=r"that cannot be evaluated ahead \(is_due\(step, 45\)\)"):
        found(loop)


def test_a_condition_on_what_changes_in_the_loop_is_refused():
    def loop(stop):
        upcoming = 60
        for step in stop(upcoming=upcoming):
            if step == upcoming:
                upcoming += 10

    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(step == upcoming\).*name the iterations"):
        found(loop)


def test_loops_inside_and_around_are_not_taken_for_the_loop():
    def loop(stop):
        for scene in ("one", "two"):
            for step in stop(scene=scene):
                for i in range(3):
                    if i == 0:
                        print("inner")
                if step == 90:
                    print("save")

    assert found(loop) == {"step == 90": [90]}


def test_an_attribute_that_stands_for_the_number():
    def loop(stop):
        trainer = SimpleNamespace(step=0)
        for step in stop(trainer=trainer):
            trainer.step = step
            if trainer.step % 30 == 0:
                print("save")

    assert found(loop) == {"step % 30 == 0": [60, 90]}


def test_conditions_on_what_an_object_keeps_from_iteration_to_iteration_are_refused():
    def attribute(stop):
        run = SimpleNamespace(saved=0)
        for step in stop(run=run):
            if step - run.saved == 10:
                run.saved = step

    def entry(stop):
        run = {"saved": 0}
        for step in stop(run=run):
            if step - run["saved"] == 10:
                run["saved"] = step

    def queue(stop):
        saves = [60, 70, 80]
        for step in stop(saves=saves):
            if step == saves[0]:
                saves.pop(0)

    for loop, condition in ((attribute, "step - run.saved == 10"), (entry, "saved'] == 10"), (queue, "step == saves")):
        with pytest.raises(SkipGSError, match=f"cannot be evaluated ahead .*{re.escape(condition)}"):
            found(loop)


def test_a_number_that_no_loop_hands_out_is_refused():
    def loop(stop):
        for _scene in ("one", "two"):
            step = 0
            while step < 100:
                step = stop()
                if step == 90:
                    print("save")

    with pytest.raises(SkipGSError, match="is not in a loop over one number"):
        found(loop)


def test_a_loop_over_more_than_the_number_is_named():
    def loop(stop):
        for index, step in enumerate(stop()):
            print(index, step)

    with pytest.raises(
        SkipGSError, match=r"one number \(for \(?index, step\)? in enumerate\(stop\(\)\)\); .* next\(batches\)"
    ):
        found(loop)


def test_a_loop_whose_numbers_are_all_taken_before_it_is_refused():
    def loop(stop):
        for step in iter(list(stop())):
            print(step)

    with pytest.raises(SkipGSError, match=r"takes all numbers before the first iteration \(for step in iter"):
        found(loop)


def test_a_source_that_cannot_be_read_is_refused():
    names = {}
    exec(compile("def loop(stop):\n    for step in stop():\n        pass\n", "no_such_file.py", "exec"), names)
    with pytest.raises(SkipGSError, match=r"source of loop\(\) .* cannot be read"):
        found(names["loop"])
