"""In a fork that no adapter knows, the gate begins after the last call and the last read of gradients that matter."""

import re

import pytest
from cases import SkipAlways
from lookalikes.splats import log
from unknown_fork import TRAIN, train, unknown_fork

from skipgs_plug import AdapterMismatchError, SkipGate


def test_loop_in_a_function_that_training_calls_is_refused():
    fork = unknown_fork(
        helper="\nreconstruct = training\ndef training(dataset, opt, pipe):\n    reconstruct(dataset, opt, pipe)\n"
    )
    with pytest.raises(
        AdapterMismatchError,
        match=r"training\(\) does not call loss.backward\(\), reconstruct\(\) calls backward in its place, .* not",
    ):
        SkipGate(fork)


def test_a_loop_without_a_variable_of_options_is_refused_before_it_begins(monkeypatch):
    monkeypatch.setattr("unknown_fork.TRAIN", re.sub(r"\bopt\b", "cfg", TRAIN))
    with pytest.raises(AdapterMismatchError, match=r"training\(\) has no variable 'opt', whose .* by hand"):
        SkipGate(unknown_fork())
    options = "opt = types.SimpleNamespace(iterations=40, densify_until_iter=20)\n"
    monkeypatch.setattr("unknown_fork.TRAIN", f"import types\n{options}" + TRAIN.replace("opt, pipe", "pipe, _"))
    with SkipGate(unknown_fork(), policy=SkipAlways()) as gate:
        train(gate.adapter.trainer)
    assert gate.report()["backwards_skipped"] == 21


def test_functions_that_the_loop_calls_are_read_too():
    helper = "\ndef nudge(gaussians):\n    inner(gaussians)\n\ndef inner(gaussians):\n    gaussians.count()\n"
    with pytest.warns(RuntimeWarning, match=r"in skipped iterations: count\(\)"):
        SkipGate(unknown_fork(extra="nudge(gaussians)", helper=helper)).detach()
    writes = helper.replace("gaussians.count()", "gaussians.values['xyz'].add_(1.0)")
    with pytest.raises(AdapterMismatchError, match=r"itself changes values \(add_\)"):
        SkipGate(unknown_fork(extra="nudge(gaussians)", helper=writes))


@pytest.mark.parametrize(
    ("extra", "start"),
    [
        ("if iteration < opt.prune_until_iter: gaussians.count()", 30),
        ("if opt.prune_until_iter >= iteration and iteration % 5 == 0: gaussians.count()", 31),
        ("if iteration in [24, 28]: gaussians.count()", 29),
        ("if iteration == 300: gaussians.count()", 20),  # the run ends before
        ("gaussians.count()", 20),
        ("if iteration > 10: gaussians.count()", 20),
        ("if iteration < 25 or opt.prune_until_iter: gaussians.count()", 20),
    ],
)
def test_gate_begins_after_the_last_call_that_is_not_recognised(extra, start, from_file):
    with pytest.warns(RuntimeWarning, match="count"):
        gate = SkipGate(from_file(extra=extra), policy=SkipAlways())
    with gate:
        if start > 20:
            with pytest.warns(RuntimeWarning, match=rf"starts at iteration {start} instead of 20: .* count\(\)"):
                train(gate.adapter.trainer)
        else:
            train(gate.adapter.trainer)
    assert gate.config.start_iter == start and gate.report()["backwards_skipped"] == 41 - start


REPORT = """
def report(model):
    log.norm = model.values["xyz"].grad.data.norm()
"""


@pytest.mark.parametrize("settings", [{}, {"share": 0.5}])
@pytest.mark.parametrize(
    "extra", ["report(gaussians)", "if opt.logs and iteration % 2: log.last = gaussians.values['xyz'].grad.norm()"]
)
def test_a_loop_that_reads_gradients_until_its_end_is_refused(extra, settings, from_file):
    """GES logs norms of gradients. A skipped iteration would end its run, such as the last one, before it saves."""
    module = from_file(extra=extra, helper=REPORT)
    with (
        pytest.raises(AdapterMismatchError, match=r"its loop reads gradients \(grad\) until its end"),
        SkipGate(module, **settings),
    ):
        train(module, logs=True)
    assert not log.backwards


@pytest.mark.parametrize("settings", [{}, {"refine_share": 0.5}])
def test_a_loop_that_puts_the_end_of_densification_off_is_refused(settings, from_file):
    """Binocular3DGS densifies until the end if its opacities decay."""
    module = from_file(extra="if opt.logs and iteration > 10: opt.densify_until_iter = opt.iterations")
    with (
        pytest.raises(AdapterMismatchError, match="its loop itself sets densify_until_iter or"),
        SkipGate(module, **settings),
    ):
        train(module, logs=True)
    assert not log.backwards
    with SkipGate(module, **settings):
        train(module, logs=False)


@pytest.mark.parametrize(
    ("extra", "start"),
    [
        ("if opt.logs: report(gaussians)", 20),
        ("if gaussians.values['xyz'].grad is not None: report(gaussians)", 20),
        ("if iteration < opt.prune_until_iter: log.last = gaussians.values['xyz'].grad", 30),
    ],
)
def test_a_loop_that_reads_no_gradient_of_a_skipped_iteration_is_gated(extra, start, from_file):
    with SkipGate(from_file(extra=extra, helper=REPORT), policy=SkipAlways()) as gate:
        if start > 20:
            with pytest.warns(RuntimeWarning, match="the loop calls for the grad of a tensor until iteration 29"):
                train(gate.adapter.trainer, logs=False)
        else:
            train(gate.adapter.trainer, logs=False)
    assert gate.config.start_iter == start and gate.report()["backwards_skipped"] == 41 - start


def test_later_prunes_of_a_fork_put_the_start_off_too(from_file):
    extra = "if iteration <= opt.prune_until_iter: gaussians.prune_points(torch.zeros(30, dtype=torch.bool))"
    sentence = r"the loop calls prune_points\(\) until iteration 30"
    with SkipGate(from_file(extra=extra), policy=SkipAlways()) as gate, pytest.warns(RuntimeWarning, match=sentence):
        train(gate.adapter.trainer)
    assert gate.config.start_iter == 31
