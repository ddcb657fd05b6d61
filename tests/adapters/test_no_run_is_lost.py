"""If any code of the gate fails, in any kind of loop, training finishes, and one warning says so."""

import math

import pytest
from cases import CASES, alone
from lookalikes.splats import log, new_log

from skipgs_plug import SkipGate
from skipgs_plug.adapters import base, nerfstudio, step_trainer
from skipgs_plug.adapters.registry import get_adapter
from skipgs_plug.core import caution, drift_check
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.pace.optimizer_steps import OptimizerSteps
from skipgs_plug.core.pace.phased import Phased
from skipgs_plug.core.policy import SkipPolicy
from tests.entries import ENTRIES

# One trainer of each kind: script, object with a strategy, callbacks, wrapped trainers, epochs, minibatches.
KINDS = ("inria", "deformable", "gsplat_default", "nerfstudio_scaled", "step_trainer", "litegs", "faster_gs", "edgs")
KINDS += ("3dgrut", "fvdb")
cases = [case for case in CASES if case.name in KINDS]
assert len(cases) == len(KINDS)
each = pytest.mark.parametrize("case", cases, ids=lambda case: case.name)

# Adapters report further facts through their hooks; a trainer calls the entry points that it has.
REACHED = {**ENTRIES, "view": (Hooks, "view"), "signal": (Hooks, "signal")}


def fail_from(monkeypatch, owner, name, iteration):
    """Let a function of the gate fail from some iteration on; gives the iterations in which it failed."""
    failed = []
    original = getattr(owner, name)

    def fails(*args, **kwargs):
        if log.now >= iteration:
            failed.append(log.now)
            raise ZeroDivisionError(f"of {name}")
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, fails)
    return failed


@pytest.mark.parametrize("entry", REACHED)
@each
def test_an_error_at_any_entry_point_releases_the_gate_once(case, entry, monkeypatch, recwarn):
    plain = alone(case)
    new_log()
    trainer, train = case.make()
    owner, name = REACHED[entry]
    failed = fail_from(monkeypatch, owner, name, case.start + 3)
    with SkipGate(trainer, warmup=0, pause_iters=0, min_bwd_ratio=0.0) as gate:
        train()
        said = [str(one.message) for one in recwarn if "released" in str(one.message)]
        if not failed:
            assert not said  # this trainer has no such call
            return
        assert len(said) == 1 and f"ZeroDivisionError: of {name}" in said[0] and gate.released == said[0]
        assert gate.patched == []
    later = range(failed[0] + 1, case.module.LAST + 1)
    assert [n for n in log.backwards if n in later] == [n for n in plain.backwards if n in later]
    assert max(log.values) == case.module.LAST and log.other_backwards == plain.other_backwards


WAYS = {"number": (Phased, "_runs"), "step": (OptimizerSteps, "begin"), "end of a step": (OptimizerSteps, "end")}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("case", [case for case in cases if case.leaves_out], ids=lambda case: case.name)
def test_an_error_while_iterations_are_left_out_releases_the_gate_once(case, way, monkeypatch, recwarn):
    new_log()
    trainer, train = case.make()
    owner, name = WAYS[way]
    failed = fail_from(monkeypatch, owner, name, case.start + 3)
    with SkipGate(trainer, refine_share=0.4, pause_iters=0) as gate:
        train()
    said = [str(one.message) for one in recwarn if "released" in str(one.message)]
    assert failed and len(said) == 1 and gate.released == said[0]
    ran = [n for n in sorted(log.values) if n > failed[0]]
    assert ran == list(range(ran[0], case.module.LAST + 1))  # nothing is left out any more


OWN = {
    "inria": (drift_check.DriftCheck, "moved"),
    "step_trainer": (step_trainer, "parameters"),
    "nerfstudio_scaled": (nerfstudio.Nerfstudio, "must_run"),
    "gsplat_default": (base.AbstractAdapter, "must_run"),
}


@pytest.mark.parametrize("name", OWN)
def test_an_error_of_an_adapters_own_code_does_the_same(name, monkeypatch, recwarn):
    case = next(case for case in cases if case.name == name)
    owner, method = OWN[name]
    if name == "gsplat_default":
        owner = get_adapter("gsplat")
    new_log()
    trainer, train = case.make()
    failed = fail_from(monkeypatch, owner, method, case.start + 3)
    with SkipGate(trainer, pause_iters=0, warmup=0, min_bwd_ratio=0.0) as gate:
        train()
    said = [str(one.message) for one in recwarn if "released" in str(one.message)]
    assert failed and len(said) == 1 and gate.released == said[0]
    assert max(log.values) == case.module.LAST


def test_where_warnings_are_errors_the_sentence_is_printed_once_and_training_goes_on(monkeypatch):
    case = next(case for case in cases if case.name == "inria")
    plain = alone(case)
    printed = []
    monkeypatch.setattr(caution, "say", printed.append)
    new_log()
    trainer, train = case.make()
    failed = fail_from(monkeypatch, SkipPolicy, "decide", case.start + 3)
    with SkipGate(trainer, warmup=0, pause_iters=0, min_bwd_ratio=0.0) as gate:
        train()
    assert printed == [gate.released] and "ZeroDivisionError: of decide" in printed[0]
    assert [n for n in log.backwards if n > failed[0]] == [n for n in plain.backwards if n > failed[0]]


@each
def test_an_error_while_an_adapter_attaches_lets_training_run_without_a_gate(case, monkeypatch, recwarn):
    def fails(*args):
        raise AttributeError("of the adapter")

    plain = alone(case)
    new_log()
    monkeypatch.setattr(Hooks, "gate_tensor_backward", fails)
    monkeypatch.setattr(Hooks, "ready", fails)
    trainer, train = case.make()
    with SkipGate(trainer, share="auto" if case.leaves_out else None) as gate:
        train()
    gate.verify()
    assert [str(one.message) for one in recwarn] == [gate.released] and gate.patched == []
    assert "AttributeError: of the adapter; report it to the project skipgs_plug" in gate.released
    assert log.backwards == plain.backwards and gate.summary() and gate.stats()["iterations"] == 0


def test_an_error_of_the_trainers_own_code_stays_its_own(monkeypatch):
    case = next(case for case in cases if case.name == "inria")

    def fails(self, *args, **kwargs):
        raise MemoryError("of the trainer")

    new_log()
    trainer, train = case.make()
    monkeypatch.setattr(case.module.GaussianModel, "reset_opacity", fails)
    with SkipGate(trainer) as gate, pytest.raises(MemoryError, match="of the trainer"):
        train()
    assert gate.released is None


def test_a_rank_whose_code_fails_raises_if_the_others_do_not_fail(monkeypatch):
    case = next(case for case in cases if case.name == "inria")
    new_log()
    trainer, train = case.make()
    fail_from(monkeypatch, drift_check.DriftCheck, "moved", case.start - 3)
    monkeypatch.setattr("skipgs_plug.core.distributed.all_failed", lambda step: False)
    with SkipGate(trainer) as gate, pytest.raises(ZeroDivisionError, match="of moved"):
        train()
    assert gate.patched == [] and log.now == case.start - 3


@pytest.mark.parametrize("mode", ["skip", "pass"])
def test_losses_that_stay_non_finite_release_the_gate_and_no_run_ends(mode, monkeypatch, recwarn):
    case = next(case for case in cases if case.name == "inria")
    plain = alone(case)
    new_log()
    trainer, train = case.make()
    original = case.module.photo_loss

    def poisoned(*args):
        return original(*args) * (math.nan if case.start <= log.now < case.start + 12 else 1.0)

    monkeypatch.setattr(case.module, "photo_loss", poisoned)
    with SkipGate(trainer, on_nonfinite=mode) as gate:
        train()
    assert "Loss is nan in iteration 29" in gate.released and "like the 9 losses before it" in gate.released
    assert gate.patched == [] and log.backwards[-30:] == plain.backwards[-30:]
