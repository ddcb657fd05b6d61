"""Conditions that the number reaches in a way that is not followed lead to a warning, and never to a silent miss."""

import contextlib
import functools
from collections import deque
from types import SimpleNamespace

import pytest
import torch
from read_milestones import found


class Scope:
    """Enters with a number that it computes; an object that exists before the loop may do so again and again."""

    def __init__(self, step=0):
        self.step = step

    def __call__(self, step):
        self.step = step
        return self

    def __enter__(self):
        self.entered = self.step
        return self.entered

    def __exit__(self, *error):
        pass


@contextlib.contextmanager
def scope(step):
    try:
        yield {"step": step}
    finally:
        print("end")


def entered_object(stop):
    for step in stop():
        with Scope(step) as n:
            if n % 40 == 0:
                print("save")


def entered_again(stop):
    at = Scope()
    for step in stop(at=at):
        with at(step) as n:
            if n == 80:
                print("save")


def entered_generator(stop):
    for step in stop():
        with scope(step) as info:
            if info["step"] % 40 == 0:
                print("save")


def entered_library(stop):
    for step in stop():
        with contextlib.nullcontext(step) as n, contextlib.ExitStack() as stack:
            other = stack.enter_context(Scope(step))
            if n == 80:
                print("save")
            if other % 40 == 0:
                print("save")


def last_of_a_queue(stop):
    recent = deque(maxlen=3)
    for step in stop(recent=recent):
        recent.append(step)
        if recent[-1] % 40 == 0:
            print("save")


def taken_from_a_queue(stop):
    recent = deque()
    for step in stop(recent=recent):
        recent.append((step, "view"))
        n, _ = recent.popleft()
        if n == 80:
            print("save")


def any_of_a_queue(stop):
    recent = deque(maxlen=3)
    for step in stop(recent=recent):
        recent.append(step)
        for n in recent:
            if n % 40 == 0:
                print("save")


def kept_in_a_tensor(stop):
    held = torch.zeros(1)
    for step in stop(held=held):
        held.fill_(step)
        if held.item() % 40 == 0:
            print("save")


def local_names_one_by_one(stop):
    for _step in stop():
        chosen = {name: value for name, value in locals().items() if name == "_step"}
        if chosen["_step"] % 40 == 0:
            print("save")


def local_names_in_a_condition(stop):
    for _step in stop():
        if vars()["_step"] % 40 == 0 or any(one % 40 == 0 for one in locals().values()):
            print("save")


def assigned_twice(stop):
    for step in stop():
        n = step
        if id(stop) == 0:
            n = 5
        if n % 40 == 0:
            print("save")


def returned_by_a_long_function(stop):
    def clipped(step):
        for _ in range(2):
            step = min(step, 100)
        return step

    for step in stop(clipped=clipped):
        n = clipped(step)
        if n % 40 == 0:
            print("save")


def before_it_is_assigned(stop):
    before = 0
    for step in stop(before=before):
        if before % 40 == 0:
            print("save")
        before = step


def under_further_names(stop):
    node = SimpleNamespace(step=0)
    node.next = node
    for step in stop():
        node = SimpleNamespace(next=node)
        node.step = step
        node = node.next
        same = node
        if same.step == 80:
            print("save")


def counted_by_a_library(stop):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))])
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, 10)
    for _step in stop(schedule=schedule):
        schedule.step()
        if schedule.last_epoch % 40 == 0:
            print("save")


def made_in_the_loop(stop):
    for step in stop():

        def save(n):
            if n % 40 == 0:
                print("save")

        save(step)


LOST = [
    *(entered_object, entered_again, entered_generator, entered_library, last_of_a_queue, taken_from_a_queue),
    *(any_of_a_queue, kept_in_a_tensor, local_names_one_by_one, local_names_in_a_condition, assigned_twice),
    *(returned_by_a_long_function, before_it_is_assigned, counted_by_a_library, under_further_names),
]


@pytest.mark.parametrize("loop", LOST)
def test_a_condition_on_a_lost_number_is_named(loop):
    with pytest.warns(
        RuntimeWarning, match=r"can depend on the iteration's number, or on how many iterations have run"
    ):
        assert found(loop) == {}


class Actions:
    """Its methods are chosen by name while the loop runs."""

    names = ("save", "log")

    def do_save(self, step):
        if step % 40 == 0:
            print("save")

    def do_log(self, step):
        print(step)


def chosen_by_name(stop):
    actions = Actions()
    for step in stop(actions=actions):
        for name in actions.names:
            getattr(actions, f"do_{name}")(step)


def chosen_from_a_table(stop):
    table = {"save": Actions().do_save, "print": print}
    for step in stop(table=table):
        for name in table:
            table[name](step)


def every(count):
    def wrap(function):
        @functools.wraps(function)
        def inner(step):
            return function(step) if step % count == 0 else None

        return inner

    return wrap


@every(40)
def save_when_due(step):
    print(step)


def decorated(stop):
    for step in stop():
        save_when_due(step)


def of_two_lambdas_in_a_line(stop):
    save, log = lambda n: n % 40 == 0 and print(), lambda n: print(n)
    for step in stop(save=save, log=log):
        save(step)


@pytest.mark.parametrize(
    "loop", [chosen_by_name, chosen_from_a_table, made_in_the_loop, decorated, of_two_lambdas_in_a_line]
)
def test_a_function_that_is_not_read_is_named(loop):
    with pytest.warns(RuntimeWarning, match="hands the iteration's number to a function that is not known"):
        assert found(loop) == {}


def test_functions_without_conditions_are_nothing_to_warn_of():
    def loop(stop):
        actions, table = Actions(), {"print": print, "log": Actions().do_log}
        for step in stop(actions=actions, table=table):
            for name in table:
                table[name](step)
            getattr(actions, f"{'do'}_log")(step)

    assert found(loop) == {}


def test_an_entry_of_a_table_is_not_all_of_it():
    def loop(stop):
        views = [{"height": 60}]
        for step in stop(views=views):
            data = views[0]
            height = data["height"]
            if height == 60:
                print("a view")
            data = {"step": step, "loss": 0.5}
            torch.save(data, f"{step}.pt")

    assert found(loop) == {}
