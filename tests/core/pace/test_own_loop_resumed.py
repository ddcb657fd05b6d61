"""`for step in gate.iterations(range(...))`: states of the gate, saved and loaded."""

import itertools
import json
from contextlib import nullcontext

import pytest
import torch
from saving_loop import VIEWS, Loop

from skipgs_plug import SkipGate, SkipGSError


@pytest.mark.parametrize("settings", [{"refine_share": 0.4}, {"refine_share": "auto"}], ids=["share", "auto"])
def test_interrupted_and_resumed_goes_as_uninterrupted(settings):
    options = {} if settings["refine_share"] != "auto" else {"views": VIEWS}
    with SkipGate(start_iter=40, **settings) as gate:
        whole = Loop(end=400).train(gate, **options)
    middle = 200
    with SkipGate(start_iter=40, **settings) as gate:
        # The loop saves in an iteration that runs. The resumed run decides on the iterations after it.
        first = Loop(end=400)
        state = None
        for step in first_part(first, gate, middle, options):
            state = step
    last = first.ran[-1]
    with SkipGate(start_iter=40, **settings) as gate:
        gate.load_state_dict(json.loads(json.dumps(state)))
        second = Loop(last + 1, 400, first.value.detach(), first.optimizer.state_dict())
        second.train(gate, **options)
    assert first.ran + second.ran == whole.ran
    assert torch.equal(second.value, whole.value)


def test_a_condition_that_holds_half_the_time_says_the_same_after_a_resume():
    def train(first, state=None):
        ran, reached, states = [], [], {}
        with SkipGate(start_iter=1, refine_share=0.3) as gate:
            if state is not None:
                gate.load_state_dict(state)
            for step in gate.iterations(range(first, 41)):
                gate.backward(torch.ones((), requires_grad=True) * 0.1, view="a", step=step)
                ran.append(step)
                states[step] = gate.state_dict()
                if step % 2 == 0:
                    reached.append(step)
        return ran, states, gate.report()["always_run"]

    whole, states, always = train(0)
    for step in (7, 11, 20):
        rest, _, again = train(step + 1, states[step])
        assert rest == [n for n in whole if n > step] and list(again.values()) == list(always.values())


def test_a_state_that_is_loaded_within_the_loop_keeps_iterations_that_conditions_name():
    with SkipGate(start_iter=10, refine_share=0.2) as gate:
        for step in gate.iterations(range(26), always=()):
            gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
        state = gate.state_dict()
    loaded, saved = False, []
    with SkipGate(start_iter=10, refine_share=0.2) as gate:
        for step in gate.iterations(range(26, 100)):
            if not loaded:
                gate.load_state_dict(state)
                loaded = True
            gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
            if step % 25 == 0:
                saved.append(step)
    assert saved == [50, 75]


def first_part(loop, gate, middle, options):
    """Train up to `middle`, giving the gate's state at the end of each iteration."""
    for step in gate.iterations(range(loop.begin, loop.end), always=range(0, 400, 25), **options):
        if step > middle:
            return
        loop.train_step(gate, step)
        yield gate.state_dict()


def test_a_state_of_another_share_is_refused():
    with SkipGate(start_iter=10, refine_share=0.4) as gate:
        Loop().train(gate)
        state = gate.state_dict()
    for settings in ({"refine_share": 0.5}, {}):
        with SkipGate(start_iter=10, **settings) as gate, pytest.raises(SkipGSError, match=r"refine_share=0\.4"):
            gate.load_state_dict(state)
    with SkipGate(start_iter=10, refine_share=0.4, enabled=False) as gate:
        gate.load_state_dict(state)
        assert Loop(begin=50).train(gate).ran == [*range(50, 100)]


def test_shares_are_named_as_they_were_given():
    asked = {
        "no share": {},
        "share='auto'": {"share": "auto"},
        "share=0.5": {"share": 0.5},
        "refine_share=0.5": {"refine_share": 0.5},
        "grow_share=0.5 and refine_share=0.4": {"grow_share": 0.5, "refine_share": 0.4},
    }
    states = {}
    for text, settings in asked.items():
        with SkipGate(start_iter=10, **settings) as gate:
            for step in gate.iterations(range(40), views=["a"], events=[5]):
                gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
                if step == 20:
                    states[text] = gate.state_dict()
    for saved, other in itertools.permutations(asked, 2):
        sentence = f"The gate state was saved with {saved}, not {other}; continue with that setting, or"
        with SkipGate(start_iter=10, **asked[other]) as gate, pytest.raises(SkipGSError, match=sentence):
            gate.load_state_dict(states[saved])


def test_a_state_of_another_schedule_is_refused():
    with SkipGate(start_iter=10, refine_share=0.4) as gate:
        states = [*first_part(Loop(), gate, 15, {})]
    sentence = "whose refinement begins at iteration 10, not 20; continue with the schedule of that run"
    with SkipGate(start_iter=20, refine_share=0.4) as gate, pytest.raises(SkipGSError, match=sentence):
        gate.load_state_dict(states[5])
    with SkipGate(start_iter=12, refine_share=0.4) as gate:
        gate.load_state_dict(states[-1])  # refinement has begun


def test_a_refused_state_changes_nothing():
    with SkipGate(start_iter=10, refine_share=0.4) as gate:
        states = [*first_part(Loop(), gate, 15, {})]
    with SkipGate(start_iter=20, refine_share=0.4) as gate:
        before = gate.state_dict()
        with pytest.raises(SkipGSError, match="whose refinement begins at iteration 10"):
            gate.load_state_dict({**states[5], "visibility": [3.0, 20.0, 20, 0.0, 0.0], "size_bound": 1.0})
        assert gate.state_dict() == before


def state_after(last, numbers):
    """Return the gate's state after iteration `last` of a loop over `numbers`, which goes on to its end."""
    with SkipGate(start_iter=10, refine_share=0.4) as gate:
        for step in gate.iterations(numbers, always=()):
            gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
            if step == last:
                state = gate.state_dict()
    return state


def test_a_loop_that_goes_on_with_more_iterations_is_refused():
    state = state_after(15, range(40))
    for numbers, refused in ((range(16, 40), False), (range(16, 400), True)):
        with SkipGate(start_iter=10, refine_share=0.4) as gate:
            gate.load_state_dict(state)
            expected = pytest.raises(SkipGSError, match="ends with iteration 39, not 399") if refused else nullcontext()
            with expected:
                next(iter(gate.iterations(numbers, always=())))


def test_a_state_with_larger_steps_does_not_go_on_without():
    state = state_after(20, range(100))
    with SkipGate(start_iter=10, refine_share=0.4, compensate=False) as gate:
        gate.load_state_dict(state)
        with pytest.raises(SkipGSError, match="saved with larger, shrinking steps, which are off now"):
            next(iter(gate.iterations(range(21, 100), always=())))
