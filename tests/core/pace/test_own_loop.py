"""`for step in gate.iterations(range(...))`: loops of one's own."""

import runpy
from contextlib import nullcontext

import pytest
import torch
from saving_loop import VIEWS, Loop

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core import distributed
from skipgs_plug.core.pace.rates import path_factor


def test_a_share_of_the_iterations_runs_and_all_that_conditions_name():
    with SkipGate(start_iter=40, refine_share=0.25) as gate:
        loop = Loop().train(gate)
    assert loop.ran == [*range(55), 75, 99]  # steps have shrunk to 0, then a save and the last iteration run
    assert loop.saved == [0, 25, 50, 75]
    assert loop.rates == [0.1 * 0.99**step for step in loop.ran]
    report = gate.report()
    assert (report["refine_share"], report["iterations_run"], report["iterations_skipped"]) == (0.25, 17, 43)
    assert sum(report["always_run"].values()) == 2
    assert report["backwards_run"] == 15 and report["reasons"] == {"full": 15, "over": 2}
    assert "17 of 60 iterations run (28.3 %)" in gate.summary()


@pytest.mark.parametrize("refine_share", [0.25, "auto"])
@pytest.mark.parametrize("options", [{}, {"always": range(0, 2000, 25)}], ids=["conditions", "always"])
def test_parts_before_refinement_leave_out_the_same_as_one_loop(refine_share, options):
    with SkipGate(start_iter=40, refine_share=refine_share) as gate:
        whole = Loop(end=2000).train(gate, views=VIEWS, **options)
    loop = Loop()
    with SkipGate(start_iter=40, refine_share=refine_share) as gate:
        for loop.begin, loop.end in ((0, 20), (20, 30), (30, 2000)):
            loop.train(gate, views=VIEWS, **options)
    assert gate.released is None and len(whole.ran) < 2000
    assert (loop.ran, loop.saved) == (whole.ran, whole.saved) and torch.equal(loop.value, whole.value)


def test_without_larger_steps_they_are_spread_evenly():
    with SkipGate(start_iter=40, refine_share=0.25, compensate=False) as gate:
        loop = Loop().train(gate)
    assert loop.ran[:40] == list(range(40)) and len(loop.ran) == 40 + 16  # the last iteration is beyond the share
    assert loop.saved == [0, 25, 50, 75] and loop.ran[-1] == 99
    assert all(2 <= sum(begin <= n < begin + 15 for n in loop.ran) <= 6 for begin in (40, 55, 70, 85))
    assert gate.report()["reasons"] == {"full": 16}


@pytest.mark.filterwarnings("error")
def test_numbers_given_as_always_are_for_conditions_that_cannot_be_read():
    gate, upcoming, ran, saved = SkipGate(start_iter=10, refine_share=0.2), 60, [], []
    for step in gate.iterations(range(100), always=[60]):
        gate.backward(torch.ones((), requires_grad=True) * 1.0, "a", step)
        ran.append(step)
        if step == upcoming:
            upcoming += 30
        if step % 45 == 44:
            saved.append(step)
    assert saved == [44, 89] and 60 in ran and 90 not in ran


def test_a_change_after_the_end_is_followed_by_iterations_that_train():
    ran = []
    with SkipGate(start_iter=40, refine_share=0.25, pause_iters=6) as gate:
        for step in gate.iterations(range(100), always=[70]):
            gate.backward(torch.ones((), requires_grad=True) * 1.0, view="a", step=step)
            ran.append((step, gate.skipped))
            if step == 70:
                gate.notify_event("prune")
    assert [row for row in ran if row[0] >= 55] == [(70, True), *((n, False) for n in range(71, 77)), (99, True)]


def test_a_change_while_the_model_recovers_is_recovered_from_as_well():
    trained = []
    with SkipGate(start_iter=40, refine_share=0.25, pause_iters=6) as gate:
        for step in gate.iterations(range(100), always=[70]):
            if gate.backward(torch.ones((), requires_grad=True) * 1.0, view="a", step=step) and step >= 55:
                trained.append(step)
            if step in (70, 73, 79):  # 79 is the last iteration that still trains
                gate.notify_event("prune")
    assert trained == list(range(71, 86))


def test_a_loop_that_goes_on_after_detach_trains_in_all_its_iterations():
    gate = SkipGate(start_iter=40, refine_share=0.25)
    trained = []
    for step in gate.iterations(range(100), always=[70]):
        if gate.backward(torch.ones((), requires_grad=True) * 1.0, view="a", step=step):
            trained.append(step)
        if step == 70:
            gate.detach()
    assert trained == [*range(55), *range(71, 100)]
    assert gate.backward(torch.ones((), requires_grad=True), view="a", step=100)


def test_steps_are_larger_while_the_gate_is_attached():
    loop, moved = Loop(), {}

    def note(optimizer, args, kwargs):
        moved[loop.ran[-1]] = optimizer.param_groups[0]["lr"] / (0.1 * 0.99 ** loop.ran[-1])

    loop.optimizer.register_step_pre_hook(note)  # after the global hooks
    gate = SkipGate(start_iter=40, refine_share=0.4)
    loop.train(gate)
    assert all(moved[step] == pytest.approx(1.0) for step in range(40))
    assert all(moved[step] == pytest.approx(path_factor(0.4, (step - 40) / 24)) for step in range(40, 64))
    assert loop.ran[64:] == [75, 99] and not {75, 99} & set(moved)  # these two have no step
    gate.detach()
    before = loop.value.detach().clone()
    loop.value.grad = torch.ones(2)
    moved.clear()
    loop.optimizer.step()
    assert next(iter(moved.values())) == pytest.approx(1.0) and not torch.equal(before, loop.value)


@pytest.mark.parametrize(
    "settings",
    [{"enabled": False, "refine_share": 0.4}, {"refine_share": 1.0, "compensate": False}, {"refine_share": 1.0}],
    ids=["off", "all", "all by default"],
)
def test_leaving_out_nothing_changes_nothing(settings):
    plain, same = Loop(), Loop()
    with SkipGate(start_iter=1000) as gate:
        plain.train(gate)
    with SkipGate(start_iter=40, **settings) as gate:
        same.train(gate)
    assert same.ran == plain.ran and torch.equal(same.value, plain.value)


def test_the_summary_says_why_more_than_the_share_ran():
    reached = []
    with SkipGate(start_iter=100, refine_share=0.25, compensate=False) as gate:
        for step in gate.iterations(range(300)):
            gate.backward(torch.tensor(0.1, requires_grad=True) * 1.0, view=f"{step % 20}.png", step=step)
            if step % 2 == 0:
                reached.append(step)
    assert gate.report()["iterations_run"] == 101
    assert "share of 0.25: 50 ran for the share, 51 for conditions of the loop, 0 after prunes" in gate.summary()


def test_the_summary_says_why_all_iterations_run_while_the_scene_grows():
    with SkipGate(start_iter=50, share=0.5, compensate=False, always=range(50)) as gate:
        for step in gate.iterations(range(100), events=range(10, 50, 10)):
            gate.backward(torch.tensor(0.1, requires_grad=True) * 1.0, view=f"{step % 5}.png", step=step)
    assert gate.report()["growing"]["iterations_skipped"] == 0
    assert "all of them run: this trainer needs them (docs/adapters.md), or they were named" in gate.summary()


def test_a_floor_that_each_process_would_find_by_itself_is_refused_in_a_group(monkeypatch):
    larger = SkipGate(start_iter=10, compensate=True)
    monkeypatch.setattr(distributed, "group_size", lambda: 2)  # the group may come after the gate
    with larger, pytest.raises(SkipGSError, match=r"by itself, but 2 train together; give min_bwd_ratio"):
        larger.iterations(range(100))
    with SkipGate(start_iter=10, compensate=True, min_bwd_ratio=0.5) as gate:
        assert len(gate.iterations(range(100))) == 100


def test_the_gate_makes_up_for_skipped_backwards_when_asked():
    with SkipGate(start_iter=40, compensate=True) as gate, pytest.raises(SkipGSError, match=r"gate\.iterations"):
        gate.backward(torch.ones((), requires_grad=True), view="a", step=50)
    factors = []
    loop = Loop(end=400)
    loop.optimizer.register_step_pre_hook(
        lambda optimizer, args, kwargs: factors.append(optimizer.param_groups[0]["lr"] / (0.1 * 0.99 ** loop.ran[-1]))
    )
    with SkipGate(start_iter=40, compensate=True, min_bwd_ratio=0.5, warmup=0) as gate:
        loop.train(gate)
    assert loop.ran == list(range(400)) and factors[40] == pytest.approx(4.0) and factors[-1] < 0.1


@pytest.mark.parametrize("settings", [{"refine_share": 0.5}, {"compensate": True}])
def test_iterations_that_come_after_the_last_one_release_the_gate_and_run(settings):
    with SkipGate(start_iter=4, **settings) as gate:
        for step in gate.iterations(range(10)):
            gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
        assert gate.iterations(range(5, 10)) and gate.iterations(range(0)) is not None
        with pytest.warns(RuntimeWarning, match=r"up to 19 come after a plan that ends with 9; give gate\.iterations"):
            rest = gate.iterations(range(10, 20))
        assert list(rest) == list(range(10, 20))


@pytest.mark.parametrize("settings", [{"refine_share": 0.5}, {"compensate": True}])
@pytest.mark.parametrize("leaves", [False, True])
def test_optimizers_that_step_after_the_loop_are_left_alone(settings, leaves):
    gate = SkipGate(start_iter=4, **settings)  # never detached
    for step in gate.iterations(range(20), always=range(20)):
        gate.backward(torch.ones((), requires_grad=True), view="a", step=step)
        if leaves and step == 10:
            break
    value = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([value], lr=0.5)
    value.grad = torch.ones(2)
    optimizer.step()
    gate.detach()
    assert value.tolist() == [-0.5, -0.5]


def test_a_trainer_that_goes_on_after_its_end_is_not_trained_backwards():
    value = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([value], lr=1.0)
    with SkipGate(start_iter=0, compensate=True, warmup=100) as gate:
        gate.iterations(range(10))
        for step in range(20):
            before = value.detach().clone()
            gate.backward((value * 1.0).sum(), view="a", step=step)
            optimizer.step()
            optimizer.zero_grad()
            assert bool((value < before).all()) if step < 10 else torch.equal(value, before)


def test_without_a_floor_steps_are_as_long_as_if_all_backwards_ran():
    value = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.SGD([value], lr=0.5)
    with SkipGate(start_iter=0, compensate=True, min_bwd_ratio=0.0, warmup=5) as gate:
        for step in gate.iterations(range(10)):
            gate.backward(value.sum(), view="a", step=step)
            before, value.grad = value[0].item(), torch.ones(2)
            optimizer.step()
            assert before - value[0].item() == pytest.approx(0.5 * path_factor(1.0, step / 10))


def test_unfit_numbers_and_settings_are_refused():
    with pytest.raises(SkipGSError, match=r"takes a range that goes up by one"):
        SkipGate(start_iter=1).iterations(range(0, 10, 2))
    for settings, sentence in [
        ({"refine_share": 0.0}, r'refine_share must be "auto" or in \(0, 1\], not 0.0'),
        ({"refine_share": "half"}, "not 'half'"),
        ({"tolerance": -1.0}, "tolerance must be a number of decibels"),
        ({"rate_peak": 0.0}, "rate_peak must be a factor above 0"),
        ({"rate_peak": 2.0, "compensate": False}, "larger steps, which compensate=False turns off"),
    ]:
        with pytest.raises(SkipGSError, match=sentence):
            SkipGate(start_iter=1, **settings)


def test_a_loop_that_forgot_iterations_is_told_in_the_first_and_trains_on():
    loss = torch.ones((), requires_grad=True)
    gate = SkipGate(start_iter=3, refine_share=0.5)
    with pytest.warns(RuntimeWarning, match=r"from 3 on, .* for step in gate\.iterations\(range\(\.\.\.\)\)"):
        assert gate.backward(loss, view="a", step=0)
    assert gate.backward(loss, view="a", step=1) and gate.backward(loss, view="a", step=2)
    for step in gate.iterations(range(3, 10), always=()):
        gate.backward(loss, view="a", step=step)
    with pytest.warns(RuntimeWarning, match="released in iteration 10, .* the gate must count them"):
        assert gate.backward(loss, view="a", step=10)  # the loop is over
    early = SkipGate(start_iter=3, refine_share=0.5)
    for step in list(early.iterations(range(10), always=())):  # the list exhausts the loop before training
        with pytest.warns(RuntimeWarning, match="the gate must count them") if step in (0, 3) else nullcontext():
            assert early.backward(loss, view="a", step=step)
    with pytest.raises(SkipGSError, match=r"refine_share leave out iterations, so the gate must count them"):
        SkipGate(start_iter=0, refine_share=0.5).backward(loss, view="a", step=0)
    off = SkipGate(start_iter=3, refine_share=0.5, enabled=False)
    assert off.backward(loss, view="a", step=9)


SCRIPT = """
import torch
from skipgs_plug import SkipGate

def evaluate(step):
    evaluated.append(step)

evaluated, ran = [], []
value = torch.nn.Parameter(torch.ones(2))
optimizer = torch.optim.Adam([value], lr=0.1)
gate = SkipGate(start_iter=40, refine_share=0.25)
if True:
    for step in gate.iterations(range(100)):
        ran.append(step)
        (value**2).sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        if step % 30 == 0:
            evaluate(step)
"""


def test_a_loop_can_stand_in_the_script_itself(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    names = runpy.run_path(str(script), run_name="__main__")
    assert names["evaluated"] == [0, 30, 60, 90] and len(names["ran"]) < 70
    names["gate"].detach()


@pytest.mark.parametrize("name", ["always", "events", "resets"])
@pytest.mark.parametrize("given", [100, "100", [100.5], ["a"]])
def test_what_is_no_iterations_is_refused_before_training(name, given):
    arguments = {"events": [5], name: given}
    with SkipGate(start_iter=10, share=0.5) as gate:
        with pytest.raises(
            SkipGSError, match=rf"{name}= takes iterations, such as range\(600, 15_000, 100\), (not|and)"
        ):
            gate.iterations(range(40), **arguments)
        with pytest.raises(SkipGSError, match="views= takes a list of all names of training views, not 10"):
            gate.iterations(range(40), views=10)
        assert gate.iterations(range(40), **{"events": [5], name: iter([20])})
