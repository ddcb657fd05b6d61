"""Ranges of a training function in which the gate may leave out numbers, and the lengths of progress bars."""

import pytest

from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.pace.loop_range import LoopRange, replace_range


class Bar:
    """A progress bar: it asks for the length once, and may be looped over."""

    def __init__(self, numbers):
        self.numbers, self.total = numbers, len(numbers)

    def __iter__(self):
        return iter(self.numbers)


class Every3rd:
    """Owner of a loop in which every third number runs."""

    wants_loop = True

    def runs(self, loop, number):
        return number % 3 == 0

    def expected(self, loop):
        return sum(number % 3 == 0 for number in loop.numbers)

    def ended(self, loop):
        assert loop.current is None


def moved_on_by_hand(end):
    bar = Bar(
        range(0, end),
    )
    ran = []
    for number in range(0, end):
        ran.append(number)
    return bar, ran


def looped_over(end):
    bar = Bar(range(0, end))
    ran = []
    for number in bar:
        ran.append(number)
    return bar, ran


def looped_over_by_another_name(end):
    numbers = range(0, end)
    bar = Bar(numbers)
    named = enumerate(bar)
    return bar, [number for _, number in named]


class Trainer:
    def kept(self, end):
        self.bar = Bar(range(0, end))
        return self.bar, list(self.bar)


def made_without_source():
    scope = {"Bar": Bar}
    exec("def unreadable(end):\n    bar = Bar(range(0, end))\n    return bar, list(bar)", scope)
    return scope["unreadable"]


def train(function, end=30):
    patches = Patches()
    code = getattr(function, "__func__", function)
    replace_range(patches, code.__globals__, (function.__name__,), Every3rd())
    try:
        return function(end)
    finally:
        patches.restore()


def test_a_bar_that_is_moved_on_by_hand_counts_all_iterations():
    bar, ran = train(moved_on_by_hand)
    assert type(bar.numbers) is range and bar.total == 30
    assert ran == list(range(0, 30, 3))


@pytest.mark.parametrize(
    "function",
    [looped_over, looped_over_by_another_name, Trainer().kept, made_without_source()],
    ids=["bar", "another name", "attribute", "no source"],
)
def test_a_bar_that_may_be_looped_over_counts_those_that_run(function):
    bar, ran = train(function)
    assert type(bar.numbers) is LoopRange and bar.total == 10
    assert ran == list(range(0, 30, 3))


def test_all_but_its_length_and_what_it_hands_out_is_as_in_the_range():
    numbers, loop = range(1, 9), LoopRange(range(1, 9), Every3rd())
    assert (list(loop), len(loop)) == ([3, 6], 2)
    assert list(reversed(loop)) == list(reversed(numbers))
    assert bool(LoopRange(range(1, 2), Every3rd())) and not LoopRange(range(0), Every3rd())
    assert (7 in loop, 9 in loop, loop[2], loop[1:3], loop.stop, repr(loop)) == (
        True,
        False,
        3,
        range(2, 4),
        9,
        "range(1, 9)",
    )


def test_a_range_that_a_module_has_of_its_own_is_used_and_comes_back():
    made = []

    def own(*numbers):
        made.append(numbers)
        return range(*numbers)

    names = {"range": own, "Bar": Bar}
    exec("def train(end):\n    return list(range(0, end))", names)
    patches = Patches()
    replace_range(patches, names, ("train",), Every3rd())
    assert names["train"](9) == [0, 3, 6]
    assert made == [(0, 9)]
    patches.restore()
    assert names["range"] is own
    assert names["train"](3) == [0, 1, 2]


def own_length(end):
    numbers = range(0, end)
    bar, ran = Bar(numbers), []
    for number in numbers:
        ran.append(number)
    return bar, [*ran, len(numbers)]


def test_the_function_itself_gets_the_length_of_its_range():
    bar, (*ran, length) = train(own_length)
    assert bar.total == len(ran) == 10 and length == 30


def named_between(end):
    numbers = range(0, end)
    saves = [7]
    for number in numbers:
        return numbers, saves, number


def test_names_that_a_function_assigns_after_its_range_are_read():
    numbers, saves, _ = train(named_between)
    code, names = numbers.source
    assert code is named_between.__code__ and names["saves"] is saves
    assert names["numbers"] == range(0, 30)
