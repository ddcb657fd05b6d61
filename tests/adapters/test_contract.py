"""The contract of every adapter, on look-alikes of the trainers (lookalikes/)."""

import copy
import json
import types

import pytest
import torch
from cases import CASES, PAUSE, RULE, SCRIPTS, SkipAlways, alone, run, same
from lookalikes.splats import Log, log, new_log

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.adapters.registry import get_adapter

each = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
resumable = [case for case in CASES if case.resume]
REAL_BACKWARD = torch.Tensor.backward
NOT_EVENTS = ("frozen", "relocate", "filter")  # these change no loss, or happen in every iteration


def rows(values):
    """All that belongs to each Gaussian  # [N, 17]"""
    return torch.cat([value.detach().flatten(1) for value in values], dim=1)


@each
def test_adapter_is_found_from_the_trainer_and_by_name(case):
    trainer, _ = case.make()
    with SkipGate(trainer) as gate:
        assert gate.adapter.name == case.module.ADAPTER
        assert "torch.Tensor.backward" in gate.patched
    with SkipGate(trainer, adapter=case.module.ADAPTER) as gate:
        assert gate.adapter.name == case.module.ADAPTER


@pytest.mark.parametrize("settings", [{"enabled": False}, {"threshold": -0.999, "warmup": 0}], ids=["off", "never"])
@each
def test_a_gate_that_skips_nothing_leaves_training_bit_identical(case, settings):
    ungated = alone(case)
    gated, gate = run(case, pause_iters=0, **settings)
    assert ungated.backwards == gated.backwards == list(case.iterations)
    assert same(ungated.current, gated.current)
    assert all(same(ungated.values[i], gated.values[i]) for i in case.iterations)
    assert (ungated.structure, ungated.steps) == (gated.structure, gated.steps)
    assert ungated.other_backwards == gated.other_backwards
    report = gate.report()
    assert report["backwards_skipped"] == 0 and report["iterations"] == len(case.iterations)
    expected = len(case.iterations) - (case.start - case.module.FIRST)
    assert report["gated_iterations"] == (expected if gate.config.enabled else 0)


@each
def test_skipping_everything_holds_the_model_still(case):
    gated, gate = run(case, policy=SkipAlways())
    first, start = case.module.FIRST, case.start
    assert gated.backwards == list(range(first, start))
    assert gate.report()["backwards_skipped"] == case.module.LAST + 1 - start
    settled = case.settled or start
    assert all(step < settled for step in gated.steps)
    if case.pending:  # a skipped iteration applied the gradients of the last backward passes
        assert start < gated.steps[-1] == settled - 1
    before, after = rows(gated.values[settled]), rows(gated.current)
    assert (after[:, None] == before[None]).all(dim=2).any(dim=1).all()  # prunes remove rows, and no other row moves
    assert len(after) == len(rows(alone(case).current))
    # The trainer's own changes go on: the same prunes of as many rows, and the backward passes that they need.
    assert gated.structure == alone(case).structure
    assert gated.other_backwards == alone(case).other_backwards


@each
def test_the_rule_decides_which_backwards_run(case):
    gated, gate = run(case, **RULE)
    skipped = [row.step for row in gate.trace if row.skip]
    assert gated.backwards == [i for i in case.iterations if i not in skipped]
    assert [row.step for row in gate.trace] == list(range(case.start, case.module.LAST + 1))
    report = gate.report()
    assert report["backwards_skipped"] == len(skipped) > 0
    assert report["backwards_run"] == report["gated_iterations"] - len(skipped) > 0
    assert report["settings"]["start_iter"] == case.start
    assert gated.structure == alone(case).structure
    assert {row["view"] for row in report["views"]} == set(case.views)


@each
def test_events_pause_the_gate(case):
    gated, gate = run(case, **RULE)
    start = case.start
    events = {step for step, kind, _ in gated.structure if step >= start - 1 and kind not in NOT_EVENTS}
    expected = sorted({i for event in events for i in range(event + 1, event + 1 + PAUSE)} & set(case.iterations))
    assert [row.step for row in gate.trace if row.reason == "pause"] == expected
    assert gate.report()["paused"] == len(expected)
    assert not any(row.skip for row in gate.trace if row.step in expected)


@pytest.mark.parametrize("case", resumable, ids=lambda case: case.name)
def test_interrupted_and_resumed_decides_as_uninterrupted(case):
    whole, gate = run(case, **RULE)
    new_log()
    middle = case.module.LAST - 16  # no gradient is pending there, which a checkpoint would lose
    trainer, train = case.make()
    with SkipGate(trainer, **RULE) as first:
        checkpoint = train(last=middle)
        state = json.loads(json.dumps(first.state_dict()))
    trainer, train = case.resume(checkpoint)
    with SkipGate(trainer, **RULE) as second:
        second.load_state_dict(state)
        train()
    assert first.trace + second.trace == gate.trace
    assert len(second.trace) == 16
    assert {row["view"] for row in second.view_table()} == set(case.views)
    assert same(log.current, whole.current)


def replaced_names(*roots):
    """Names of everything reachable from these objects that a gate has put in place."""
    found, seen, waiting = [], set(), list(roots)
    while waiting:
        thing = waiting.pop()
        if id(thing) in seen or not hasattr(thing, "__dict__"):
            continue
        seen.add(id(thing))
        for name, value in list(vars(thing).items()):
            if hasattr(value, "__skipgs_plug__"):
                found.append(name)
            if isinstance(value, type) or "lookalikes" in type(value).__module__:
                waiting.append(value)
        if not isinstance(thing, (type, types.ModuleType)):
            waiting.append(type(thing))
    return found


@each
def test_nothing_stays_replaced(case, monkeypatch):
    trainer, train = case.make()
    new_log()
    gate = SkipGate(trainer)
    assert gate.patched and replaced_names(trainer)
    gate.detach()
    assert not gate.patched and not replaced_names(trainer) and torch.Tensor.backward is REAL_BACKWARD

    def begins(self, iteration, parameters):
        if iteration == case.module.FIRST + 3:
            raise ZeroDivisionError

    monkeypatch.setattr(Log, "begins", begins)
    with pytest.raises(ZeroDivisionError), SkipGate(trainer) as gate:
        train()
    assert not gate.patched and not replaced_names(trainer) and torch.Tensor.backward is REAL_BACKWARD


@each
def test_two_gates_on_one_trainer_are_refused(case):
    trainer, _ = case.make()
    with SkipGate(trainer) as gate:
        names = copy.copy(gate.patched)
        with pytest.raises(SkipGSError, match=r"gated already: detach\(\) the other gate first"):
            SkipGate(trainer)
        assert gate.patched == names and replaced_names(trainer)
    assert not replaced_names(trainer) and torch.Tensor.backward is REAL_BACKWARD


@pytest.mark.parametrize("case", SCRIPTS, ids=lambda case: case.name)
def test_answers_about_a_run_change_nothing(case, monkeypatch):
    adapter, answers = get_adapter(case.module.ADAPTER), []

    def twice(ask):
        def asked(self, opt, loop):
            before = dict(vars(self))
            answers.append((ask(self, opt, loop), ask(self, opt, loop)))
            assert vars(self) == before
            return answers[-1][0]

        return asked

    monkeypatch.setattr(adapter, "start_iter", twice(adapter.start_iter))
    monkeypatch.setattr(adapter, "gradients_read_until", twice(adapter.gradients_read_until))
    new_log()
    trainer, train = case.make()
    with SkipGate(trainer):
        train(last=case.module.FIRST)
    assert len(answers) >= 2 and all(one == other for one, other in answers)  # some answers are computed from others


@pytest.mark.parametrize("case", SCRIPTS, ids=lambda case: case.name)
def test_the_training_function_will_do_for_its_module(case):
    new_log()
    with SkipGate(case.module.training, **RULE) as gate:
        case.make()[1]()
    assert gate.adapter.name == case.module.ADAPTER
    assert gate.report()["iterations"] == len(case.iterations)
