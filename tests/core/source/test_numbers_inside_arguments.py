"""Conditions are found if a function gets the number inside a table, a tuple or a new object."""

from dataclasses import dataclass
from types import SimpleNamespace

from read_milestones import found


def numbers(loop):
    """Numbers that the conditions of a loop name, in order."""
    return sorted(set().union(*found(loop).values()))


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
            pass_on(step, step=step, loss=len(str(step)))

    assert numbers(loop) == [71, 80, 90]


def test_arguments_that_stars_hide():
    def loop(stop):
        for step in stop():
            loss = len(str(step))
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
            save({"step": step, "loss": len(str(step))}, (step, len(str(step))))

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
            save(SimpleNamespace(step=step, loss=len(str(step))), 45)
            progress = Progress(step, "scene")
            save(progress, 33)

    assert numbers(loop) == [50, 66, 71, 80, 90, 99]
