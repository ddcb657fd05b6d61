"""`for step in gate.iterations(range(...))` with `refine_share="auto"`."""

import pytest
import torch
from saving_loop import VIEWS, Loop

from skipgs_plug import SkipGate, SkipGSError


def test_after_detach_no_view_is_only_watched():
    names = [f"{i}.png" for i in range(40)]
    gate, trained = SkipGate(start_iter=0, refine_share="auto"), set()
    for step in gate.iterations(range(2000), always=(), views=names):
        ran = gate.backward(torch.ones((), requires_grad=True) * 1.0, view=names[step % 40], step=step)
        if step == 1:
            gate.detach()
        elif step > 1 and ran:
            trained.add(names[step % 40])
        if step == 80:
            break
    assert trained == set(names)


def test_auto_ends_where_nothing_is_gained_and_runs_on_where_conditions_hold():
    ran, reached, optimizer = [], [], torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    with SkipGate(start_iter=100, refine_share="auto") as gate:
        for step in gate.iterations(range(2100), views=[f"{i}.png" for i in range(40)]):
            ran.append(step)
            loss = torch.tensor(0.1, requires_grad=True)
            if gate.backward(loss * 1.0, view=f"{step % 40}.png", step=step):
                optimizer.step()
            if step % 500 == 0:
                reached.append(step)
    report = gate.report()
    # A quarter of a fifth of 2,000 iterations runs, and iterations 500, 1,000, 1,500, 2,000 and the last.
    assert report["iterations_run"] == 100 + 5 and ran[-4:] == [1000, 1500, 2000, 2099]
    assert report["early_stopping"]["ended_early"] and "ended early, in cycle 2" in gate.summary()
    assert report["early_stopping"]["rest_worth_db"] == 0.0
    assert report["reasons"]["over"] > 0 and report["reasons"]["watched"] > 0


def test_auto_runs_the_whole_share_where_views_are_too_few_to_watch():
    ran, optimizer = [], torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=0.1)
    with SkipGate(start_iter=100, refine_share="auto") as gate:
        for step in gate.iterations(range(2100), views=[f"{i}.png" for i in range(20)]):
            ran.append(step)
            loss = torch.tensor(0.1, requires_grad=True)
            if gate.backward(loss * 1.0, view=f"{step % 20}.png", step=step):
                optimizer.step()
    report = gate.report()
    assert report["iterations_run"] == 400 + 1 and report["early_stopping"]["watched"] == []
    assert report["backwards_skipped"] == 1  # that of the last iteration, when steps have shrunk to 0
    assert "no view is watched" in gate.summary()
    assert "a twelfth of 20 training views is less than 3 views" in gate.summary()


def test_auto_leaves_a_short_refinement_as_it_is():
    plain, same = Loop(end=300), Loop(end=300)
    with SkipGate(start_iter=1000) as gate:
        plain.train(gate)
    with SkipGate(start_iter=40, refine_share="auto") as gate:
        same.train(gate, views=VIEWS)
    assert same.ran == plain.ran and torch.equal(same.value, plain.value)
    assert "refinement is too short, or views come up too seldom" in gate.summary()
    longer = Loop(end=1040)
    with SkipGate(start_iter=40, refine_share="auto", compensate=False) as gate:
        longer.train(gate, views=VIEWS)
    assert len(longer.ran) < 600 and "refinement is too short" not in gate.summary()


def test_auto_must_know_the_views():
    sentence = r"give their names to gate\.iterations\(\) as views=, or a share"
    for unknown in ({}, {"views": []}):
        with SkipGate(start_iter=10, refine_share="auto") as gate, pytest.raises(SkipGSError, match=sentence):
            Loop().train(gate, **unknown)
    with SkipGate(start_iter=10, refine_share="auto") as gate, pytest.raises(SkipGSError, match="views= takes a list"):
        gate.iterations(range(100), views="0.png")


def test_views_named_twice_are_known_once():
    reports = []
    for views in (VIEWS, VIEWS * 40):
        with SkipGate(start_iter=40, refine_share="auto") as gate:
            Loop(end=600).train(gate, views=views)
        reports.append(gate.report()["refine_share"])
    assert reports[0] == reports[1] < 1
