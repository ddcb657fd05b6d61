"""An error of the gate's own code in a loop of one's own: the loop trains on as without a gate, and is told once."""

import subprocess
import sys

import pytest
import torch

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core import decision
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.optimizers import has_pending_gradient
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.pace.rates import ScaledRates
from skipgs_plug.core.policy import SkipPolicy
from tests.entries import ENTRIES

LAST, FAILS = 80, 40
VIEWS = ["a.png", "b.png"]


class Loop:
    """A loop with every verb; keeps the numbers in which a gradient was used."""

    def __init__(self, batch=False):
        self.weight = torch.nn.Parameter(torch.zeros(1))
        self.optimizer = torch.optim.SGD([self.weight], lr=0.1)
        self.batch = batch
        self.stepped = []
        self.now = None

    def losses(self):
        return [(self.weight - 1 - step).square().mean() for step in range(2)]

    def train(self, gate, numbers):
        for self.now in numbers:
            losses = self.losses()
            if self.batch:
                ran = gate.backward(losses, view=list(VIEWS), step=self.now)
            else:
                ran = gate.backward(losses[self.now % 2], view=VIEWS[self.now % 2], step=self.now)
            if gate.step(self.optimizer):
                self.optimizer.zero_grad(set_to_none=True)
                self.stepped.append(self.now)
            assert ran is (self.stepped[-1:] == [self.now])
            gate.update()
            if self.now % 10 == 5:
                gate.notify_event("prune")
        return self


REACHED = {**ENTRIES, "record": (Engine, "decide")}


def fail_from(monkeypatch, owner, name, loop):
    original = getattr(owner, name)

    def fails(*args, **kwargs):
        if loop.now is not None and loop.now >= FAILS:
            raise ZeroDivisionError(f"of {name}")
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, fails)


WAYS = [(entry, False) for entry in REACHED]
WAYS += [(entry, True) for entry in REACHED if entry != "backward"]  # a batch is decided view by view


@pytest.mark.parametrize(("entry", "batch"), WAYS)
def test_an_error_in_any_verb_releases_the_gate_once(entry, batch, monkeypatch, recwarn):
    loop = Loop(batch)
    fail_from(monkeypatch, *REACHED[entry], loop)
    gate = SkipGate(start_iter=0, warmup=0, pause_iters=0, min_bwd_ratio=0.0)
    loop.train(gate, range(LAST))
    said = [str(one.message) for one in recwarn]
    assert len(said) == 1 and f"ZeroDivisionError: of {REACHED[entry][1]}" in said[0] and gate.released == said[0]
    later = range(FAILS + 6, LAST)
    assert len(loop.stepped) < LAST and [step for step in loop.stepped if step in later] == list(later)
    seen, why = gate.summary().splitlines()
    assert f"{gate.stats()['iterations']} iterations seen" in seen and gate.stats()["iterations"] >= FAILS
    assert why.strip() == gate.report()["released"] == gate.released


def test_optimizers_that_cannot_be_read_step_all_the_same(monkeypatch, recwarn):
    loop = Loop()

    def fails(optimizer):
        if loop.now >= FAILS:
            raise AttributeError("param_groups")
        return has_pending_gradient(optimizer)

    monkeypatch.setattr("skipgs_plug.core.own_loop.has_pending_gradient", fails)
    gate = SkipGate(start_iter=0, min_bwd_ratio=1.0)
    assert loop.train(gate, range(LAST)).stepped == list(range(LAST))
    assert [str(one.message) for one in recwarn] == [gate.released] and "param_groups" in gate.released


def test_an_error_of_the_pace_lets_all_numbers_run(monkeypatch, recwarn):
    loop = Loop()
    fail_from(monkeypatch, Phased, "_runs", loop)
    gate = SkipGate(start_iter=10, refine_share=0.3)
    numbers = gate.iterations(range(LAST), always=(FAILS,))
    loop.train(gate, numbers)
    assert [str(one.message) for one in recwarn] == [gate.released]
    assert [step for step in loop.stepped if step > FAILS] == list(range(FAILS + 1, LAST))
    assert len(numbers) == LAST and list(gate.iterations(range(5))) == list(range(5))


def test_a_bad_key_is_refused_in_the_first_iteration_and_releases_later(recwarn):
    loop = Loop()
    gate = SkipGate(start_iter=0)
    with pytest.raises(SkipGSError, match="view"):
        gate.backward(loop.losses()[0], view=object(), step=0)
    gate = SkipGate(start_iter=0)
    for step in range(20):
        assert gate.backward(loop.losses()[0], view=object() if step == 9 else "a.png", step=step)
    assert [str(one.message) for one in recwarn] == [gate.released] and "in iteration 9" in gate.released


def test_second_part_of_a_loop_that_cannot_be_planned_releases_the_gate(recwarn):
    loop, upcoming = Loop(), 60
    gate = SkipGate(start_iter=50, refine_share=0.3)
    loop.train(gate, range(40))
    for step in gate.iterations(range(40, LAST)):
        gate.backward(loop.losses()[0], view="a.png", step=step)
        loop.stepped.append(step)
        if step == upcoming:
            upcoming += 10
    assert loop.stepped == list(range(LAST)) and "(step == upcoming)" in gate.released
    assert [str(one.message) for one in recwarn][1:] == [gate.released]  # the first warning asks for gate.iterations()


def test_an_error_of_the_loops_own_backward_stays_its_own():
    loss = torch.ones((), requires_grad=True) * 2
    loss.backward()
    gate = SkipGate(start_iter=0)
    with pytest.raises(RuntimeError, match="second time"):
        gate.backward(loss * 1, view="a.png", step=0) and gate.backward(loss, view="a.png", step=1)
    assert gate.released is None


@pytest.mark.parametrize("entry", ["SkipPolicy.decide", "ScaledRates.ran"])
def test_each_backward_runs_once_when_the_gate_fails_in_the_second_view(entry, monkeypatch, recwarn):
    weight = torch.nn.Parameter(torch.zeros(1))
    calls = []

    def fails(*args):
        calls.append(args)
        if len(calls) == 2:
            raise ZeroDivisionError("in the second view")

    if entry == "SkipPolicy.decide":  # before the backward pass of the view
        monkeypatch.setattr(SkipPolicy, "decide", lambda *args: fails(*args) or decision.WARM_UP)
    else:  # after it
        monkeypatch.setattr(ScaledRates, "ran", fails)
    gate = SkipGate(start_iter=0)
    for view in VIEWS:
        assert gate.backward(weight.sum(), view=view, step=0)
    assert weight.grad == 2 and gate.released == str(recwarn.pop().message)


def test_a_loop_may_try_again_after_an_error_of_its_own_backward(monkeypatch, recwarn):
    weight = torch.nn.Parameter(torch.zeros(1))
    gate = SkipGate(start_iter=0)
    loss = weight.sum()
    loss.backward = lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        gate.backward(loss, view="a.png", step=0)
    assert gate.released is None
    monkeypatch.setattr(Engine, "open_iteration", lambda *args: 1 / 0)
    assert gate.backward(weight.sum(), view="a.png", step=1)  # this error is the gate's
    assert weight.grad == 1 and gate.released == str(recwarn.pop().message)


SCRIPT = """
import torch
from skipgs_plug import SkipGate
from skipgs_plug.core.policy import SkipPolicy
weight = torch.nn.Parameter(torch.zeros(1))
real, calls = SkipPolicy.decide, []
def fails(*args):
    calls.append(args)
    if len(calls) > 10:
        raise ZeroDivisionError("of the policy")
    return real(*args)
SkipPolicy.decide = fails
gate = SkipGate(start_iter=0)
for step in range(30):
    assert gate.backward((weight - 1).square().mean(), view="a.png", step=step)
print("trained", gate.released is not None)
"""


def test_where_warnings_are_errors_training_goes_on_and_the_sentence_is_printed_once():
    run = subprocess.run([sys.executable, "-W", "error", "-c", SCRIPT], capture_output=True, text=True, check=False)
    assert run.returncode == 0 and run.stdout == "trained True\n", run.stderr
    assert run.stderr.count("ZeroDivisionError: of the policy") == 1 and "Traceback" not in run.stderr
    assert run.stderr.startswith("skipgs-plug: The gate is released in iteration 10")
