"""The contract of every adapter when whole iterations are left out, on look-alikes of the trainers."""

import json

import pytest
import torch
from cases import CASES, note_begun, run, same
from lookalikes import inria, step_trainer
from lookalikes.splats import Log, log, new_log

from skipgs_plug import SkipGate
from skipgs_plug.core.errors import SkipGSError

LOOPS = [case for case in CASES if case.leaves_out]
each = pytest.mark.parametrize("case", LOOPS, ids=lambda case: case.name)
resumable = [case for case in LOOPS if case.resume]
SHARE = 0.4


@pytest.fixture
def begun(monkeypatch):
    """Numbers of the iterations that began."""
    return note_begun(monkeypatch)


@each
def test_a_share_of_the_iterations_runs_and_nothing_that_hangs_on_numbers_is_lost(case, begun):
    plain = run(case)[0]
    begun.clear()
    gated, gate = run(case, refine_share=SHARE, pause_iters=0)
    start, last = case.refined_from, case.module.LAST
    assert begun[: start - case.module.FIRST] == list(range(case.module.FIRST, start))
    refined = [n for n in begun if n >= start]
    report = gate.report()
    assert refined == sorted(set(refined)) and refined[-1] == last and len(refined) == report["iterations_run"]
    assert report["iterations_run"] + report["iterations_skipped"] == last + 1 - start
    always = sum(report["always_run"].values())
    assert len(refined) <= SHARE * (last + 1 - start) + always + 2
    assert gated.structure == plain.structure  # the same prunes, resets and relocations in the same iterations
    assert gated.other_backwards == plain.other_backwards
    assert gated.backwards == [n for n in begun if n in gated.backwards]
    assert report["backwards_run"] == len([n for n in gated.backwards if n >= start])
    assert report["backwards_run"] <= max(SHARE * (last + 1 - start), always) + 2


@pytest.mark.parametrize(
    "settings", [{"refine_share": 1.0}, {"refine_share": 0.4, "enabled": False}], ids=["all", "off"]
)
@each
def test_leaving_out_nothing_leaves_training_bit_identical(case, settings):
    plain = run(case)[0]
    gated, _ = run(case, **settings)
    assert plain.backwards == gated.backwards and same(plain.current, gated.current)
    assert (plain.structure, plain.steps) == (gated.structure, gated.steps)


@each
def test_rates_are_the_trainers_own_between_steps(case, monkeypatch):
    def rates_of(settings):
        seen = {}
        original = Log.begins

        def begins(self, iteration, parameters):
            seen[begins.before] = [group["lr"] for one in alive for group in one.param_groups]
            begins.before = iteration
            return original(self, iteration, parameters)

        begins.before = None
        with monkeypatch.context() as patch:
            patch.setattr(Log, "begins", begins)
            run(case, **settings)
        return seen

    alive = []
    original_init = torch.optim.Adam.__init__

    def noted(self, *args, **kwargs):
        original_init(self, *args, **kwargs)
        alive.append(self)

    monkeypatch.setattr(torch.optim.Adam, "__init__", noted)
    plain = rates_of({})
    alive.clear()
    gated = rates_of({"refine_share": SHARE})
    assert len(gated) < len(plain)
    for number, rates in gated.items():  # also rates of schedulers that count calls
        assert rates == pytest.approx(plain[number], rel=1e-9)


@pytest.mark.parametrize("case", resumable, ids=lambda case: case.name)
def test_interrupted_and_resumed_leaves_out_the_same(case, begun):
    settings = {"refine_share": SHARE}
    whole, _ = run(case, **settings)
    numbers = list(begun)
    last = case.module.LAST
    later = [
        n for n in numbers if last - 16 <= n < last
    ]  # no gradient is pending at the first, which a checkpoint would lose
    middle = later[0] if later else numbers[-2]
    new_log()
    begun.clear()
    trainer, train = case.make()
    with SkipGate(trainer, **settings) as first:
        checkpoint = train(last=middle)
        state = json.loads(json.dumps(first.state_dict()))
    trainer, train = case.resume(checkpoint)
    with SkipGate(trainer, **settings) as second:
        second.load_state_dict(state)
        train()
    assert begun == numbers
    if case.module.ADAPTER not in ("nerfstudio",):  # its schedulers are not in the look-alike's checkpoint
        assert same(log.current, whole.current)


def test_a_progress_bar_that_is_moved_on_by_hand_counts_all_iterations(monkeypatch):
    bars = []

    class Bar:
        def __init__(self, numbers, **_):
            self.total, self.at, self.closed = len(numbers), 0, False
            bars.append(self)

        def update(self, count):
            self.at += count

        def close(self):
            self.closed = True

    monkeypatch.setattr(inria, "tqdm", Bar)
    gate = run(next(case for case in CASES if case.module is inria), refine_share=SHARE)[1]
    assert gate.report()["iterations_skipped"] > 0
    assert [(bar.total, bar.at, bar.closed) for bar in bars] == [(60, 60, True)]


@each
def test_no_range_stays_replaced(case):
    trainer, _ = case.make()
    gate = SkipGate(trainer, refine_share=SHARE)
    replaced = [name for name in gate.patched if name.endswith(".range")]
    assert len(replaced) == 1
    gate.detach()
    assert gate.patched == [] and "range" not in vars(case.module)


def test_a_loop_around_a_pip_trainer_is_written_with_the_gates_iterations():
    def train(numbers, trainer):
        for step in numbers:
            trainer.step(step_trainer.pick_camera(step_trainer.dataset(), step))
        return trainer

    new_log()
    train(range(1, 61), plain := step_trainer.make())
    structure = list(log.structure)
    new_log()
    trainer = step_trainer.make()
    with SkipGate(trainer, refine_share=SHARE) as gate:
        for step in gate.iterations(range(1, 61)):
            trainer.step(step_trainer.pick_camera(step_trainer.dataset(), step))
            assert trainer.curr_step == step
    assert gate.report()["iterations_run"] == 16 + 3  # a share, and three that raise the SH degree
    assert trainer.raised == plain.raised == 6
    assert [event for event in structure if event[0] < 21] == log.structure
    trainer = step_trainer.make()
    with SkipGate(trainer, refine_share=SHARE), pytest.warns(RuntimeWarning, match="No loop over range"):
        train(iter(list(range(1, 61))), trainer)  # the gate is released, and the run is not lost
    assert trainer.curr_step == 60


ONLY_BACKWARDS = [case for case in CASES if not case.leaves_out and case.name != "step_trainer"]


@pytest.mark.parametrize("case", ONLY_BACKWARDS, ids=lambda case: case.name)
def test_a_loop_that_cannot_be_shortened_is_refused_before_anything_runs(case, begun):
    trainer, _ = case.make()
    with pytest.raises(SkipGSError, match="cannot leave out whole iterations"):
        SkipGate(trainer, refine_share=SHARE)
    assert begun == [] and torch.Tensor.backward.__module__ == "torch._tensor"
