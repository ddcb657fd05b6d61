"""Conditions in functions that a loop calls with its number are those of the loop, if the functions are the user's."""

import functools
import importlib.util
import random
import runpy
from types import SimpleNamespace

import project_helpers
import pytest
import torch
from project_helpers import Saver, Trainer, is_late, log, switch, while_switched_on
from read_milestones import found, numbers

from skipgs_plug import SkipGate, SkipGSError


def maybe_save(step, saves, model=None):
    if step in saves:
        print(model)


def test_functions_of_the_same_file_and_of_the_project():
    def loop(stop):
        for step in stop(saves=[60, 99, 1000]):
            maybe_save(step, [51])
            maybe_save(model=print(step), saves=(70, 71), step=step)
            log(step)
            project_helpers.write(step, every=45)

    assert found(loop) == {
        "step in [51]": [51],
        "step in (70, 71)": [70, 71],
        "line 56 of project_helpers.py: (step + 1) % write.every == 0": [59, 89],
        "line 56 of project_helpers.py: step % 45 == 0": [90],
    }


def test_methods_of_objects():
    def loop(stop):
        saver = Saver(40)
        step_with = Saver(33).step
        for step in stop(saver=saver, step_with=step_with):
            saver.step(step)
            step_with(step)
            new = Saver(45)
            new.step(step)

    assert numbers(loop) == [66, 80, 90, 99]
    assert numbers(Trainer().train) == [50, 60, 75, 77, 90]


class Every:
    """Saves every so many steps, when it is called."""

    def __init__(self, every):
        self.every = every

    def __call__(self, step):
        if step % self.every == 0:
            print("save")


def test_objects_that_are_called_and_lambdas():
    def loop(stop):
        save, due = Every(40), lambda step: step % 33 == 0
        trainer = SimpleNamespace(save=Every(47), by=Saver(49).step)
        for step in stop(save=save, due=due, trainer=trainer):
            save(step)
            trainer.save(step)
            trainer.by(step)
            if due(step):
                print("due")

    assert numbers(loop) == [66, 80, 94, 98, 99]


def test_partial_functions():
    def save(folder, every, step):
        if step % every == 0:
            print(folder)

    def loop(stop):
        often, rarely = functools.partial(save, "out", 40), functools.partial(save, "out", every=60)
        for step in stop(often=often, rarely=rarely):
            often(step)
            rarely(step=step)

    assert numbers(loop) == [60, 80]


def test_each_of_several_callbacks_is_read():
    def loop(stop):
        hooks, savers = [Every(40), lambda step: step == 71 and print("save")], (Saver(33), Saver(49))
        for step in stop(hooks=hooks, savers=savers):
            for hook in hooks:
                hook(step)
            if step < 90:
                for saver in savers:
                    saver.step(step)

    assert numbers(loop) == [66, 71, 80]


def test_a_function_that_gets_the_number_in_a_table_is_read():
    def evaluate(info, state):
        if info["step"] % 45 == 0 or state["late"] == 25:
            print("evaluate")

    def loop(stop):
        state = {}
        for step in stop(state=state, evaluate=evaluate):
            loss = len(hex(step))
            state["late"] = step - 50
            info = {"step": step, "loss": loss}
            evaluate(info, state)

    assert numbers(loop) == [75, 90]


def test_callbacks_in_a_comprehension_are_read_one_by_one():
    def loop(stop):
        hooks = [Every(40), lambda step: step == 71 and print("save")]
        for step in stop(hooks=hooks):
            [hook(step) for hook in hooks]

    assert numbers(loop) == [71, 80]


def test_a_long_list_of_objects_is_no_list_of_callbacks():
    def loop(stop):
        views = [Every(40)] * 17
        for step in stop(views=views):
            for view in views:
                view(step)

    assert numbers(loop) == []


def test_result_of_a_function_in_a_condition():
    def loop(stop):
        for step in stop():
            if is_late(step) and step != 80:
                print("late")
            last = is_late(step, start=90)
            if last:
                print("last")

    assert numbers(loop) == [70, 90]


def test_function_that_tells_a_range_of_numbers_needs_none_of_them():
    def is_warm(step, until=70):
        if step < 60:
            return True
        return step < until

    def loop(stop):
        for step in stop(is_warm=is_warm):
            if is_warm(step):
                print("warm")

    assert numbers(loop) == []


def test_guards_in_called_functions_and_around_the_call():
    def loop(stop):
        saver = Saver(10, begin=75)
        for step in stop(saver=saver, off=False):
            if step < 85:
                saver.step(step)
            if step > 95:
                continue
            maybe_save(step, [96, 97, 55])

    def off(stop):
        saver, force = Saver(10), False
        for step in stop(saver=saver, force=force):
            _ = force and saver.step(step)

    assert numbers(loop) == [55, 80]
    assert numbers(off) == []


def test_function_inside_the_function_that_holds_the_loop():
    def loop(stop):
        every, saved = 35, []

        def save(step):
            if step % every == 0:
                saved.append(step)

        for step in stop(every=every, saved=saved, save=save):
            save(step)

    assert numbers(loop) == [70]


def test_condition_that_cannot_be_evaluated_is_one_warning_with_its_place():
    def loop(stop):
        saver = Saver(40)
        for step in stop(saver=saver):
            saver.by_account(step)
            maybe_save(step, [*saver.saved, len(hex(step))])

    sentence = (
        r"line \d+ of \S*project_helpers.py \(step - saver.last == 20\), line \d+ of \S*test_called_functions.py "
        r"\(step in maybe_save.saves\); name the iterations that must run \(--always, always=\)\."
    )
    with pytest.warns(RuntimeWarning, match=sentence) as said:
        assert found(loop) == {}
    assert len(said) == 1


def test_run_with_such_a_condition_trains_and_is_warned_once_for_both_phases(recwarn):
    saver, weight, ran = Saver(25), torch.nn.Parameter(torch.zeros(1)), []
    optimizer = torch.optim.SGD([weight], lr=0.1)
    with SkipGate(start_iter=50, share=0.4) as gate:
        for step in gate.iterations(range(100), events=range(10, 50, 10)):
            gate.backward((weight - 1).square().mean(), view="a.png", step=step)
            gate.step(optimizer)
            ran.append(step)
            saver.by_account(step)
    said = [str(one.message) for one in recwarn if "depend on functions" in str(one.message)]
    assert len(said) == 1 and len(ran) < 80 and gate.released is None


def test_condition_of_the_loop_on_a_value_that_a_called_function_changes_is_a_warning():
    def loop(stop):
        saver = Saver(40)
        saver.last = 60
        for step in stop(saver=saver):
            if step == saver.last:
                print("the loop's own condition")
            saver.by_account(step)

    with pytest.warns(RuntimeWarning, match=r"depend on functions that the loop calls .* \(step == saver.last\)"):
        assert numbers(loop) == [60]


def test_conditions_where_the_loop_ends_name_no_iterations(recwarn):
    def loop(stop):
        saver = Saver(40)
        for step in stop(saver=saver):
            while saver.last == "paused":
                if saver.last is None:
                    saver.by_account(step)
                    return
            if step == 70:
                print(step % 9)
                raise RuntimeError("the condition itself is one of the loop's")
            saver.last = step

    assert numbers(loop) == [70]
    assert not recwarn


def test_constant_that_a_function_may_switch_counts_as_on():
    def loop(stop):
        for step in stop():
            while_switched_on(step)
            switch()

    assert numbers(loop) == [60, 80]


def test_names_of_a_function_are_not_those_of_the_loop():
    def check(number):
        every = 45
        for step in range(3):  # not the iteration's number
            print(step)
        kept = [step for step in range(60) if step == 55]
        if number % every == 0:
            print("save", kept)

    def loop(stop):
        every = 10
        for step in stop(check=check, every=every):
            check(step)

    assert numbers(loop) == [90]


def test_parameter_that_a_function_assigns_is_not_known():
    def late(step):
        step += 1
        if step % 10 == 0:
            print("save")

    def loop(stop):
        for step in stop(late=late):
            late(step)

    with pytest.warns(RuntimeWarning, match=r"\(late.step % 10 == 0\)"):
        assert found(loop) == {}


def test_function_that_calls_itself_is_read_once():
    def again(step, times):
        if step == 60:
            print("save")
        again(step, times - 1)

    def loop(stop):
        for step in stop(again=again):
            again(step, 3)

    assert numbers(loop) == [60]


WRITE = """
def write(step):
    if step % {every} == 0:
        print(step)
"""
LOOP = """
def loop(stop):
    for step in stop(helpers=helpers, library=library):
        helpers.write(step)
        library.write(step)
        random.seed(step)
"""


def test_functions_of_libraries_are_not_read_though_they_lie_in_the_project(tmp_path):
    names = {"__name__": "train", "random": random}
    for name, folder, every in (("helpers", "tools", 45), ("library", "venv/site-packages", 10)):
        path = tmp_path / folder / f"{name}.py"
        path.parent.mkdir(parents=True)
        path.write_text(WRITE.format(every=every))
        specification = importlib.util.spec_from_file_location(name, path)
        names[name] = importlib.util.module_from_spec(specification)
        specification.loader.exec_module(names[name])
    script = tmp_path / "train.py"
    script.write_text(LOOP)
    exec(compile(LOOP, script, "exec"), names)
    assert numbers(names["loop"]) == [90]


def test_run_that_leaves_out_iterations_saves_all_that_its_functions_save():
    saver, weight = Saver(25), torch.nn.Parameter(torch.zeros(1))
    optimizer, ran = torch.optim.SGD([weight], lr=0.1), []
    with SkipGate(start_iter=10, refine_share=0.2) as gate:
        for step in gate.iterations(range(101)):
            gate.backward((weight - 1).square().mean(), view="a.png", step=step)
            gate.step(optimizer)
            ran.append(step)
            saver.step(step)
    assert saver.saved == [0, 25, 50, 75, 100] and len(ran) < 40


def test_functions_that_read_the_number_from_the_loops_variable(tmp_path):
    def loop(stop):
        def save():
            if step % 45 == 0:
                print(step)

        every = lambda count: step % count == 0  # noqa: E731
        for step in stop(save=save, every=every):
            save()
            if every(33):
                print(step)

    assert numbers(loop) == [66, 90, 99]
    script = tmp_path / "script.py"
    script.write_text(SHARED)
    assert runpy.run_path(str(script))["saved"] == [0, 30, 60, 90]


SHARED = """
from skipgs_plug import SkipGate

def save():
    if step % 30 == 0:
        saved.append(step)

saved = []
for step in SkipGate(start_iter=10, refine_share=0.2).iterations(range(100)):
    save()
"""


def test_a_loop_that_yields_its_number_is_refused():
    def steps(gate, **options):
        for step in gate.iterations(range(100), **options):
            yield step, None

    with pytest.raises(SkipGSError, match=r"Line \d+ of .* yields the iteration's number to other code"):
        list(steps(SkipGate(start_iter=10, refine_share=0.2)))
    assert (30, None) in list(steps(SkipGate(start_iter=10, refine_share=0.2), always=[30]))


def test_an_iterator_that_another_function_made_is_refused_with_its_name():
    def made(gate):
        return gate.iterations(range(100))

    with pytest.raises(SkipGSError, match=r"^made\(\) of .* has ended"):
        for _ in made(SkipGate(start_iter=10, refine_share=0.2)):
            pass
