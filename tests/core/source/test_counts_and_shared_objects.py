"""Counts of functions and lengths are warned of; shared objects and PyTorch's modules hand the number on."""

import functools
import threading
from collections import Counter, deque
from types import SimpleNamespace

import pytest
import torch
from read_milestones import found, numbers


class Counting(torch.nn.Module):
    """Counts its calls, and those of its other methods, without the number."""

    def __init__(self):
        super().__init__()
        self.calls, self.kept, self.gathered = 0, [], 0

    def forward(self, value):
        self.calls += 1
        if self.calls % 40 == 0:
            print("save")
        return value

    def keep(self, value):
        self.kept.append(value)
        if len(self.kept) % 40 == 0:
            print("save")

    def gather(self):
        self.gathered += 1
        if self.gathered == 4:  # over the iterations that run
            self.gathered = 0


calls = [0]


def tick(count=calls):
    count[0] += 1
    if count[0] == 40:
        print("save")


def tick_anew(count=calls):
    count[0] += 1
    if count[0] >= 40:
        print("save")
        count[0] = 0


def length_of_a_queue(stop):
    losses = deque()
    for _step in stop(losses=losses):
        losses.append(0.5)
        if len(losses) == 40:
            print("save")


def length_in_an_object(stop):
    run = Counting()
    for _step in stop(run=run):
        run.keep(0.5)


def count_of_a_module(stop):
    run = Counting()
    for _step in stop(run=run):
        run(0.5)


def count_of_a_function(stop):
    for _step in stop():
        tick()


def count_that_a_function_sets_back(stop):
    for _step in stop():
        tick_anew()


def count_below_a_function(stop):
    def work():
        tick()

    for _step in stop(work=work):
        work()


def count_that_is_assigned(stop):
    left = 200
    for _step in stop(left=left):
        left = left - 1
        if left == 40:
            print("save")


COUNTED = [
    *(length_of_a_queue, length_in_an_object, count_of_a_module, count_of_a_function, count_below_a_function),
    *(count_that_is_assigned, count_that_a_function_sets_back),
]


@pytest.mark.parametrize("loop", COUNTED)
def test_lengths_and_functions_that_count_are_named(loop):
    with pytest.warns(RuntimeWarning, match="counts the iterations that run"):
        assert found(loop) == {}


def test_lengths_and_counts_that_do_not_tell_an_iteration_are_nothing_to_warn_of():
    def loop(stop):
        recent, batch, run, tags = deque(maxlen=10), [], Counting(), Counter()
        for step in stop(recent=recent, batch=batch, run=run, tags=tags):
            recent.append(0.5)
            if len(recent) == 10:  # from the tenth on
                print(sum(recent) / 10)
            batch.append(step)
            if len(batch) == 4:
                batch.clear()
            run.gather()
            for index in range(8):
                if index % 4 == 0:
                    print("inner")

    assert found(loop) == {}


class Net(torch.nn.Module):
    """A module with modules, whose condition is in the innermost one."""

    def __init__(self, *inner):
        super().__init__()
        self.inner = torch.nn.ModuleList(inner)

    def forward(self, step):
        if step == 71:
            print("save")
        for one in self.inner:
            one(step)


class Watch:
    """Knows its run, which holds the number."""

    def __init__(self, run):
        self.run = run

    def look(self):
        self.draw()

    def draw(self):
        if self.run.step == 72:
            print("draw")


run = SimpleNamespace(step=0)
table = {"step": 0}


def look_at_run():
    if run.step == 73 or table["step"] == 74:
        print("save")


current = 0


def put_current(step):
    global current
    current = step


def save_current():
    if current == 75:
        print("save")


def test_modules_of_pytorch_are_read():
    def loop(stop):
        net = Net(Net(), torch.nn.Identity())
        for step in stop(net=net):
            net(step)
            net.inner[0](step + 1)

    with pytest.warns(RuntimeWarning, match="hands the iteration's number"):  # of the list's entry
        assert numbers(loop) == [71]


def test_objects_under_several_names_are_one():
    def loop(stop):
        watch, same = Watch(run), run
        for step in stop(watch=watch, same=same):
            same.step = table["step"] = step
            put_current(step)
            watch.look()
            look_at_run()
            save_current()

    assert numbers(loop) == [72, 73, 74, 75]


class Actions:
    """Its methods are chosen by a name that its caller knows."""

    def do_save(self, step):
        if step % 40 == 0:
            print("save")

    def fire(self, name, step):
        getattr(self, f"do_{name}")(step)


def test_functions_that_a_loop_makes_and_texts_that_are_put_together():
    def loop(stop):
        actions = Actions()
        for step in stop(actions=actions):
            actions.fire("save", step)

            def closure():
                if step == 71:  # noqa: B023
                    print("save")

            threading.Thread(target=closure).start()

    assert numbers(loop) == [71, 80]


def test_parts_of_cases_stages_and_tables_that_are_emptied():
    def loop(stop):
        actions = {66: "save", 77: "log"}
        for step in stop(actions=actions):
            match divmod(step, 40):
                case _, 0:
                    print("save")
            match {"rest": step % 45}:
                case {"rest": 0}:
                    print("evaluate")
            if step // 33 > (step - 1) // 33:
                print("stage")
            state = {}
            state.update({"step": step})
            if state["step"] == 51:
                print("begin")
            action = actions.pop(step, None)
            if action:
                print(action)

    assert numbers(loop) == [51, 66, 77, 80, 90, 99]


@functools.lru_cache(8)
def kept_result(step):
    if step == 71:
        print("save")


def deep(step, depth=4):
    kept_result(step)


def test_functions_with_kept_results():
    def loop(stop):
        for step in stop():
            deep(step)

    assert numbers(loop) == [71]
