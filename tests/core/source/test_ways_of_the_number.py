"""Conditions are found if the number reaches them inside a value, through another function, or through a kept value."""

import asyncio
import math
import operator
import os
import queue
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import InitVar, dataclass
from decimal import Decimal
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from read_milestones import found, numbers

from skipgs_plug import SkipGSError


def save_every_40(step, scene=None):
    if step % 40 == 0:
        print("save", scene)


def test_further_arguments():
    def by_name(**given):
        if given["step"] % 45 == 0:
            print("save")

    def by_place(scene, *given):
        step, last = given
        if step == last:
            print("save")

    def pass_on(*values, **given):
        save_every_40(*values)
        by_name(**given)

    def loop(stop):
        for step in stop(by_name=by_name, by_place=by_place, pass_on=pass_on):
            by_place("scene", step, 71)
            pass_on(step, step=step, loss=len(hex(step)))

    assert numbers(loop) == [71, 80, 90]


def test_arguments_that_stars_hide():
    def loop(stop):
        for step in stop():
            loss = len(hex(step))
            save_every_40(*(step, loss))
            info = {"step": step - 1, "loss": loss}
            save_every_40(**info)
            save_every_40(**{"step": step - 2, "scene": loss})

    assert numbers(loop) == [80, 81, 82]


def test_new_tables_and_tuples():
    def save(table, pair):
        if table["step"] % 40 == 0 or pair[0] == 71:
            print("save", pair[1])

    def loop(stop):
        for step in stop(save=save):
            save({"step": step, "loss": len(hex(step))}, (step, len(hex(step))))

    assert numbers(loop) == [71, 80]


@dataclass
class Context:
    """Fields become attributes without a source."""

    step: int
    scene: str = ""


class Progress:
    """Keeps its arguments under other names, and acts when it is made."""

    def __init__(self, number, scene):
        self.step, self.scene = number, scene
        if self.step == 71 or self.due(50):
            print("save")

    def due(self, every):
        return self.step % every == 0


def test_new_objects():
    def save(context, every):
        if context.step % every == 0:
            print("save", context)

    def loop(stop):
        for step in stop(save=save):
            save(Context(step, "scene"), 40)
            save(SimpleNamespace(step=step, loss=len(hex(step))), 45)
            progress = Progress(step, "scene")
            save(progress, 33)

    assert numbers(loop) == [50, 66, 71, 80, 90, 99]


@dataclass
class Due:
    """Acts when it is made, by its fields and by a value that is no field."""

    step: int
    every: InitVar[int]

    def __post_init__(self, every):
        if self.step == 71 or self.step % every == 0:
            print("save")


def test_dataclasses_that_act_when_they_are_made():
    def loop(stop):
        for step in stop():
            Due(step, every=40)

    assert numbers(loop) == [71, 80]


class Saving:
    """Saves at the end of a block, or when it is told."""

    def __init__(self, number, every):
        self.number, self.every = number, every

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.save()

    @property
    def late(self):
        return self.number == 72

    def save(self):
        if self.number % self.every == 0:
            print("save")


class Paused(Saving):
    """Gives another value to the name of the block."""

    def __init__(self, number):
        self.number, self.every = number, 1000

    def __enter__(self):
        return self.number


def test_methods_of_new_objects():
    def loop(stop):
        for step in stop():
            with Saving(step, 40), Saving(step, 45) as late:
                print(late)
            Saving(step, 33).save()
            saving = Saving(step, 71)
            saving.save()

    assert numbers(loop) == [66, 71, 80, 90, 99]


def test_dictionaries_of_the_local_names():
    def save(names):
        if names["step"] % 40 == 0:
            print("save")

    def by_name(step, **others):
        if step % 45 == 0:
            print("save", others, vars())

    def loop(stop):
        for step in stop(save=save, by_name=by_name):
            save(locals())
            by_name(**vars())
            if step > 60 and "loss" in locals():  # no condition on the number alone
                print("late")

    assert numbers(loop) == [80, 90]


def test_async_functions():
    async def save(step):
        if step % 40 == 0:
            print("save")

    async def due(step):
        return step % 45 == 0

    async def work(step):
        await save(step)
        if await due(step):
            print("save")

    def loop(stop):
        for step in stop(work=work, save=save, due=due):
            asyncio.run(work(step))

    assert numbers(loop) == [80, 90]


def test_functions_that_are_handed_over_with_the_number():
    def save(step, every):
        if step % every == 0:
            print("save")

    def loop(stop):
        hooks = [lambda step: step == 71 and print("save")]
        pool = ThreadPoolExecutor(1)
        for step in stop(save=save, hooks=hooks, pool=pool):
            threading.Thread(target=save, args=(step,), kwargs={"every": 40}).start()
            pool.submit(save, step, every=45)
            pool.submit(lambda: save(step, 33))  # noqa: B023
            list(map(lambda hook: hook(step), hooks))  # noqa: C417

    assert numbers(loop) == [66, 71, 80, 90, 99]


def test_functions_in_a_registry():
    def loop(stop):
        hooks = {"step": [save_every_40], "end": lambda step: step == 99 and print("end")}
        for step in stop(hooks=hooks):
            for hook in hooks.get("step", []):
                hook(step)
            hooks["end"](step)
            hooks.get("none", print)(step)

    assert numbers(loop) == [80, 99]


def test_all_functions_of_a_registry():
    def loop(stop):
        hooks = {"save": save_every_40, "end": lambda step: step == 99 and print("end")}
        for step in stop(hooks=hooks):
            for hook in hooks.values():
                hook(step)

    assert numbers(loop) == [80, 99]


class Schedule:
    """Its methods need no object, or are looked up by name."""

    every = 40

    @classmethod
    def is_due(cls, step):
        return step % cls.every == 0

    def save(self, step):
        if step == 71:
            print("save")


def test_methods_of_classes_and_methods_by_name():
    def loop(stop):
        schedule = Schedule()
        for step in stop(schedule=schedule):
            if Schedule.is_due(step) or schedule.is_due(step - 1):
                print("save")
            getattr(schedule, "save")(step)  # noqa: B009

    assert numbers(loop) == [71, 80, 81]


def test_the_number_as_a_value_of_a_library():
    def save(step):
        if step % 40 == 0 or str(step).endswith("9"):
            print("save")

    def loop(stop):
        for step in stop(save=save):
            count = np.int64(step - 1)
            if count % 40 == 0 or torch.tensor(step, dtype=torch.int64).item() == 71:
                print("save")
            save(Decimal(step - 2))
            if f"{step:04d}".endswith("66") or math.floor(step / 2) == 49:
                print("evaluate")

    assert numbers(loop) == [51, 61, 66, 71, 81, 82, 91, 98, 99]


def test_what_a_library_computes_from_the_number_is_not_known():
    def save(step):
        if step % 40 == 0:
            print("save")

    def in_loop(stop):
        for step in stop():
            rest = operator.mod(step, 40)
            if rest == 0:
                print("save")

    def in_function(stop):
        for step in stop(save=save):
            save(operator.index(step))

    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(operator.mod\(step, 40\) == 0\)"):
        found(in_loop)
    with pytest.warns(RuntimeWarning, match=r"depend on functions .* \(save.step % 40 == 0\)"):
        assert found(in_function) == {}


def test_a_number_that_a_module_keeps_gets_a_warning():
    def keep(step):
        os.environ["STEP"] = str(step)

    def loop(stop):
        for step in stop(keep=keep):
            keep(step)

    with pytest.warns(RuntimeWarning, match=r"Line \d+ of .* \(os.environ\['STEP'\]\) keeps the iteration's number"):
        assert found(loop) == {}


def test_a_number_that_a_queue_or_a_generator_receives_gets_a_warning():
    def save_some():
        while True:
            print((yield) % 40)

    def loop(stop):
        steps, some = queue.Queue(), save_some()
        for step in stop(steps=steps, some=some):
            steps.put({"step": step})
            some.send(step)

    with pytest.warns(RuntimeWarning, match="keeps the iteration's number for other code") as said:
        assert found(loop) == {}
    assert [str(one.message).split("(")[1] for one in said] == ["steps.put", "some.send"]


def test_objects_of_a_with_statement():
    def loop(stop):
        for step in stop():
            with Saving(step, 40) as saving, Paused(step) as other:
                if saving.number == 71 or saving.late or other == 73:
                    print("evaluate")

    assert numbers(loop) == [71, 72, 73, 80]


current = 0


def save_current(every):
    if current % every == 0:
        print("save")


def test_calls_and_global_names_that_keep_the_number():
    def loop(stop):
        global current
        state, steps, run = {}, [0], SimpleNamespace()
        for step in stop(state=state, steps=steps, run=run):
            state.update(step=step)
            steps.append(step - 1)
            setattr(run, "last", step)  # noqa: B010
            if state["step"] == 71 or steps[-1] == 71 or run.last == 73:
                print("save")
            current = step
            save_current(40)

    assert numbers(loop) == [71, 72, 73, 80]


def test_a_range_without_gaps_is_a_stretch_of_the_run():
    def loop(stop):
        for step in stop():
            if step not in range(60, 90):
                print("no pause")
                if step % 25 == 0:
                    print("densify")
            if step in range(95):
                print("a stretch of them")
            if step in range(60, 90, 10):
                print("save")

    assert found(loop) == {"step % 25 == 0": [50], "step in range(60, 90, 10)": [60, 70, 80]}
