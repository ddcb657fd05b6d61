"""Conditions that only move a progress bar hold no iterations, and the bar ends where it would."""

import io
import sys

import pytest
import torch
from tqdm import tqdm

from skipgs_plug import SkipGate
from skipgs_plug.core.source.lines import line_of
from skipgs_plug.core.source.reading import read_loop

NUMBERS = range(1, 101)


class NoBar(list):
    def update(self, by):
        self.append(by)

    def set_postfix(self, *args):
        pass


def bar():
    return tqdm(range(100), file=io.StringIO())


def read(loop):
    """Iterations that a loop holds by condition, and how its bars are moved."""
    caught = []

    class Stopped(Exception):
        pass

    def stop(**names):
        code = sys._getframe(1).f_code
        names = {**loop.__globals__, **names}
        read = read_loop(code, line_of(code), names)
        caught.extend([read.milestones(NUMBERS), read.bar_moves(NUMBERS)])
        raise Stopped

    with pytest.raises(Stopped):
        loop(stop)
    held, moved = caught
    return sorted(set().union(*held.values())), [
        (one.by, sorted(n for n in NUMBERS if n in one.numbers)) for one in moved
    ]


def test_a_bar_that_moves_on_every_tenth_iteration_holds_none():
    def loop(stop):
        shown, mean, model = bar(), 0.0, [1, 2]
        for iteration in stop(shown=shown, model=model):
            mean = 0.4 * iteration + 0.6 * mean
            with torch.no_grad():
                if iteration % 10 == 0:
                    shown.set_postfix({"Loss": f"{mean:.{7}f}", "N": f"{len(model)}"})
                    shown.update(10)
                if iteration == 100:
                    shown.close()

    assert read(loop) == ([100], [(10, list(range(10, 101, 10)))])


def test_texts_for_the_bar_and_moves_in_every_iteration_are_no_more():
    def loop(stop):
        shown = bar()
        for iteration in stop(shown=shown):
            shown.update()
            if iteration % 5 == 0:
                texts = {"step": f"{iteration}"}
                if iteration % 2:
                    texts = {"odd": str(round(iteration / 2, 1))}
                shown.set_postfix(texts)
            else:
                shown.set_description("...")

    assert read(loop) == ([], [(1, list(NUMBERS))])


def work(step):
    """Stand for the body of a loop."""


kept = []


def prints(stop):
    shown = bar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            shown.update(10)
            print(step)


def works_in_the_text(stop):
    shown = bar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            shown.set_postfix({"loss": work(step)})


def works_beside(stop):
    shown = bar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            shown.update(10)
        else:
            work(0)


def keeps(stop):
    shown, last = bar(), 0
    for step in stop(shown=shown):
        if step % 10 == 0:
            last = str(step)
            shown.set_postfix_str(last)
    return last


def keeps_elsewhere(stop):
    shown = bar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            kept[0] = str(step)
            shown.update(10)


def another_object(stop):
    shown = NoBar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            shown.update(10)


def does_nothing(stop):
    shown = bar()
    for step in stop(shown=shown):
        if step % 10 == 0:
            pass


def moves_by_what_happened(stop):
    shown, done = bar(), 0
    for step in stop(shown=shown):
        done += len(kept)
        if step % 10 == 0:
            shown.update(done)


@pytest.mark.parametrize(
    "loop",
    [
        prints,
        works_in_the_text,
        works_beside,
        keeps,
        keeps_elsewhere,
        another_object,
        does_nothing,
        moves_by_what_happened,
    ],
    ids=lambda loop: loop.__name__,
)
def test_whatever_does_more_holds_its_iterations(loop):
    assert read(loop) == (list(range(10, 101, 10)), [])


def test_a_bar_ends_where_it_would_and_fewer_iterations_run():
    ran, ends = {}, {}
    for name in ("bar", "no bar"):
        shown = bar() if name == "bar" else NoBar()
        weight = torch.nn.Parameter(torch.zeros(1))
        optimizer = torch.optim.SGD([weight], lr=0.1)
        gate = SkipGate(start_iter=50, refine_share=0.2)
        ran[name] = []
        for iteration in gate.iterations(range(1, 1001)):
            gate.backward((weight - 1).square().mean(), view="a", step=iteration)
            gate.step(optimizer)
            ran[name].append(iteration)
            if iteration % 10 == 0:
                shown.update(10)
        ends[name] = getattr(shown, "n", 0)
        gate.detach()
    assert ends["bar"] == 1000
    assert len(ran["bar"]) == pytest.approx(49 + 0.2 * 951, abs=2)
    assert len(ran["no bar"]) - len(ran["bar"]) > 60
