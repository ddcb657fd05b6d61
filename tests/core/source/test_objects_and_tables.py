"""Iterations that properties of objects, tables and counters of objects name."""

from contextlib import suppress
from types import SimpleNamespace

import pytest
from read_milestones import found, numbers

from skipgs_plug import SkipGSError

STAGES = {60: "save", 99: "evaluate", 1000: "never"}
SETTINGS = {"saves": [60, 99], "test": {"every": 45}}


class State:
    """Knows the present step, and decides by it."""

    def __init__(self, every=45):
        self.step = self.count = self.gathered = 0
        self.every, self.limit, self.saved = every, 60, []

    @property
    def due(self):
        return self.step % self.every == 0

    @property
    def due_late(self):
        return self.due and self.step > 60

    @property
    def saves_itself(self):
        if self.step == 77:
            self.saved.append(self.step)
        return len(self.saved)

    @property
    def since_last(self):
        return self.step - self.saved[-1] == 10

    @property
    def counted(self):
        return self.count % 20 == 0

    def tick(self):
        self.count += 1

    def gather(self):
        self.gathered += 1
        if self.gathered == 4:  # counts the iterations that run
            self.gathered = 0

    def save_at_limit(self, step):
        if step >= self.limit:
            self.limit += 10

    def train(self, stop):
        for step in stop(self=self):
            self.step = step
            if self.due:
                print("save")


def test_properties_of_an_object_that_holds_the_number():
    def loop(stop):
        state, trainer = State(), SimpleNamespace(state=State(40))
        for step in stop(state=state, trainer=trainer):
            state.step = trainer.state.step = step
            late = state.due_late
            if late:
                print("save")
            if step > 60 and trainer.state.due:
                print("evaluate")
            print(state.saves_itself)

    assert numbers(loop) == [77, 80, 90]
    assert found(State().train) == {"step % self.every == 0": [90]}


class Run:
    """Keeps the step in a property, in an entry, or by a method; and acts when it is set."""

    def __init__(self):
        self._step, self.held = 0, {}

    step = property(lambda self: self._step)

    @step.setter
    def step(self, value):
        self._step = value
        if value == 71:
            print("save")

    def begin(self, step):
        self._step = step

    def save(self):
        if self._step % 40 == 0:
            print("save")

    def __setitem__(self, key, value):
        self.held[key] = value
        if key == "step" and value == 72:
            print("save")

    def __getitem__(self, key):
        return self.held[key]

    def get(self, key, default=None):
        return self.held.get(key, default)


def test_properties_that_are_set():
    def loop(stop):
        run, other = Run(), Run()
        for step in stop(run=run, other=other):
            run.step = other.step = step
            run.save()
            if run.step == 81 or other._step == 82:
                print("evaluate")

    assert numbers(loop) == [71, 80, 81, 82]


def test_methods_that_keep_the_number():
    def loop(stop):
        run = Run()
        for step in stop(run=run):
            run.begin(step)
            run.save()
            if run._step == 81:
                print("evaluate")

    assert numbers(loop) == [80, 81]


def test_entries_of_objects():
    def loop(stop):
        run = Run()
        for step in stop(run=run):
            run["step"] = step
            if run["step"] == 81 or run.get("step") == 82 or run.held["step"] == 83:
                print("evaluate")

    assert numbers(loop) == [72, 81, 82, 83]


def test_a_property_that_is_no_condition_on_the_number_is_evaluated():
    class Options:
        step = 0
        every = property(lambda self: 40)

    def loop(stop):
        options = Options()
        for step in stop(options=options):
            options.step = step
            if step % options.every == 0:
                print("save")

    assert found(loop) == {"step % options.every == 0": [80]}


def test_a_property_that_cannot_be_evaluated_is_a_warning_with_its_place():
    def loop(stop):
        state = State()
        for step in stop(state=state):
            state.step = step
            if state.since_last:
                state.saved.append(step)

    with pytest.warns(RuntimeWarning, match=r"line 38 of \S*_tables.py \(step - state.saved\[-1\] == 10\)"):
        assert found(loop) == {}


def test_tables():
    def loop(stop):
        flags, actions = [step in (70, 71) for step in range(100)], {75: print, 76: len}
        for step in stop(flags=flags, actions=actions):
            if step in SETTINGS["saves"] or step % SETTINGS["test"]["every"] == 0:
                print("save")
            if flags[step]:
                print("flagged")
            with suppress(KeyError):
                actions[step + 1](step)
            STAGES.get(step, print)(step)

    assert found(loop) == {
        "step in SETTINGS['saves'] or step % SETTINGS['test']['every'] == 0": [60, 90, 99],
        "flags[step]": [70, 71],
        "step + 1 in actions": [74, 75],
        "step in STAGES": [60, 99],
    }


def test_a_table_that_the_loop_fills_or_that_has_all_numbers_names_none():
    def loop(stop):
        losses, order, views = {}, list(range(50, 150)), {step: f"{step}.png" for step in range(100)}
        for step in stop(losses=losses, order=order, views=views):
            losses[step] = order[step]
            print(losses[step], views[step])

    assert found(loop) == {}


def test_a_table_in_a_function_that_gets_the_number():
    def act(step, table):
        try:
            return table[step]
        except KeyError:
            return None

    def loop(stop):
        for step in stop(act=act):
            act(step, STAGES)

    assert found(loop) == {"step in STAGES": [60, 99]}


def test_a_table_that_the_loop_empties_is_refused():
    def loop(stop):
        stages = dict(STAGES)
        for step in stop(stages=stages):
            if stages.pop(step, None):
                print("save")

    with pytest.raises(SkipGSError, match=r"cannot be evaluated ahead \(stages.pop\(step, None\)\)"):
        found(loop)


def counting_loop(stop):
    state = State()
    for _step in stop(state=state):
        state.count += 1
        if state.counted:
            print("save")


def counting_object(stop):
    state = State()
    for _step in stop(state=state):
        state.tick()
        if state.counted:
            print("save")


@pytest.mark.parametrize("loop", [counting_loop, counting_object])
def test_a_property_on_a_counter_is_warned_of(loop):
    with pytest.warns(RuntimeWarning, match=r"Line 42 of \S*tables.py \(state.count % 20 == 0\) counts the iterations"):
        found(loop)


def test_gathering_in_an_object_is_nothing_to_warn_of():
    def loop(stop):
        state = State()
        for _step in stop(state=state):
            state.gather()

    assert found(loop) == {}


def test_a_limit_that_an_object_moves_is_warned_of():
    def loop(stop):
        state = State()
        for step in stop(state=state):
            state.save_at_limit(step)

    with pytest.warns(RuntimeWarning, match=r"Line 53 of \S*tables.py \(step >= state.limit\) moves its own limit"):
        found(loop)


class Every20th:
    """An object that is called in each iteration, and counts the calls."""

    calls = 0

    def __call__(self):
        self.calls += 1
        return self.calls % 20 == 0


def test_an_object_that_counts_its_own_calls_is_warned_of():
    def loop(stop):
        is_due = Every20th()
        for _step in stop(is_due=is_due):
            if is_due():
                print("save")

    with pytest.warns(RuntimeWarning, match=r"\(is_due.calls % 20 == 0\) counts the iterations"):
        found(loop)
