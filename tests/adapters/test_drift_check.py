"""A fork whose loop moves the model in skipped iterations: the gate gives up, and training goes on."""

from types import SimpleNamespace

import pytest
from cases import CASES, SkipAlways
from lookalikes.splats import Log, log, new_log

from skipgs_plug import SkipGate
from skipgs_plug.core import drift_check

# Look-alikes of trainers whose optimizers the adapter knows: one whose loop is a function, and three that are objects.
WATCHED = ("inria", "gsplat_default", "nerfstudio", "step_trainer")


@pytest.fixture(params=WATCHED)
def case(request):
    return next(case for case in CASES if case.name == request.param)


@pytest.fixture
def shaken(monkeypatch):
    """Move the positions at the beginning of each iteration, as a fork's own noise would."""
    begins = Log.begins

    def moves(own, iteration, parameters):
        begins(own, iteration, parameters)
        own.current[0].data += 0.01

    monkeypatch.setattr(Log, "begins", moves)


def test_what_moves_the_model_in_skipped_iterations_releases_the_gate(case, shaken, recwarn):
    new_log()
    trainer, train = case.make()
    with SkipGate(trainer, policy=SkipAlways(), pause_iters=0) as gate:
        train()
    assert gate.released is not None and "whose backward was skipped" in gate.released
    assert [one for one in recwarn if str(one.message) == gate.released]
    assert f"The loop moved xyz in iteration {case.start + 1}" in gate.released
    assert log.backwards[-1] == case.module.LAST == max(log.values)
    assert gate.report()["backwards_skipped"] == 2  # the first has nothing to compare with; xyz moved in the second


def test_a_model_that_keeps_still_in_skipped_iterations_is_gated_to_the_end(case):
    new_log()
    trainer, train = case.make()
    with SkipGate(trainer, policy=SkipAlways(), pause_iters=0) as gate:
        train()
    assert gate.released is None and gate.report()["backwards_skipped"] > 20


def test_one_of_several_ranks_does_not_give_up_alone(shaken, monkeypatch):
    case = next(case for case in CASES if case.name == "inria")
    new_log()
    trainer, train = case.make()
    monkeypatch.setattr(drift_check, "distributed", SimpleNamespace(group_size=lambda: 2))
    with SkipGate(trainer, policy=SkipAlways(), pause_iters=0) as gate:
        train()
    assert gate.released is None
