"""The contract of every adapter when iterations are also left out while the scene grows, on look-alikes."""

import json

import pytest
from cases import CASES, alone, note_begun, run, same
from lookalikes.splats import log, new_log

from skipgs_plug import SkipGate
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace import densification_events, needs

LOOPS = [case for case in CASES if case.leaves_out]
each = pytest.mark.parametrize("case", LOOPS, ids=lambda case: case.name)
# Budgets, constant shares and resolutions by event: all of their events are kept.
KEEP_ALL_EVENTS = {"taming", "mcmc", "improved_gs", "gns", "dash_gaussian"}
SHARE = 0.4
# Iterations that must all run, by adapter: a further term of the loss acts on the model in each of them.
WHOLE = {"gns": range(20, 31), "gaussianspa": range(20, 41)}


@pytest.fixture
def begun(monkeypatch):
    """Numbers of the iterations that began."""
    return note_begun(monkeypatch)


@pytest.fixture(scope="module")
def shortened():
    """Log of each trainer with a share, and the numbers of the iterations that ran."""
    logs = {}

    def get(case):
        if case.name not in logs:
            gated = run(case, share=SHARE, pause_iters=0)[0]
            logs[case.name] = gated, sorted(gated.values)
        return logs[case.name]

    return get


@pytest.fixture
def short(monkeypatch):
    """Let "auto" find a share below 1 in runs as short as these, and leave out some of their few events."""
    monkeypatch.setattr(densification_events, "LEAST_EVENTS", 1)
    monkeypatch.setattr(needs, "LEAST_GROWING_STEPS", 6)
    monkeypatch.setattr(needs, "LEAST_GROWING_STEPS_LONGER", 6)
    monkeypatch.setattr(needs, "STEPS_PER_EVENT", 1)
    monkeypatch.setattr(needs, "GROWING_VISITS", 1.0)
    monkeypatch.setattr(needs, "LEAST_STEPS_AFTER_FEW", 8)


def beside(entries, events):
    """Return all changes of the model except densification events: iteration and kind."""
    return [(step, kind) for step, kind, _ in entries if step not in events]


@pytest.mark.parametrize("share", [SHARE, "auto"])
@each
def test_events_are_left_out_and_everything_else_happens_exactly_as_often(case, share, begun, short):
    plain = alone(case)
    events = set(plain.behind)
    begun.clear()
    gated, gate = run(case, share=share, pause_iters=0)
    report, start = gate.report(), case.refined_from
    grown = [n for n in begun if n < start]
    assert begun == sorted(set(begun)) and begun[-1] == case.module.LAST
    assert gated.happened == plain.happened  # SH, saves, ADMM and the like
    assert beside(gated.structure, events) == beside(plain.structure, events)  # prunes, resets, new models
    assert gated.other_backwards == plain.other_backwards
    # Events that run have their number, and the gradients that were gathered since the previous event.
    assert set(gated.behind) == events & set(begun)
    before = case.module.FIRST - 1
    for event, gathered in gated.behind.items():
        earliest = min(n for n in plain.values if n > before)
        since = [n for n in begun if earliest <= n <= event]
        assert gathered <= len(since)
        if any(plain.behind.values()):  # MCMC gathers no gradients
            assert len(since) - gathered <= start_of_gathering(plain, case)
        before = event
    growing = report["growing"]
    if not events:
        assert grown == list(range(case.module.FIRST, start))  # this script has no densification
        return
    assert growing["events_run"] == len(gated.behind)
    assert growing["events_run"] + growing["events_skipped"] == len(events)
    asked = growing["iterations_run"] + growing["iterations_skipped"]
    assert asked == start - case.module.FIRST - 1  # in the first iteration the loop is not known yet
    whole = WHOLE.get(case.module.ADAPTER, range(0))
    assert set(whole) <= set(begun) and len(grown) < start - case.module.FIRST
    if case.module.ADAPTER in KEEP_ALL_EVENTS or "mcmc" in case.name:
        assert growing["events_skipped"] == 0
    else:
        assert growing["events_skipped"] > 0


def start_of_gathering(plain, case):
    """Iterations of the run before the first that gathers gradients for densification."""
    first = min(plain.behind)
    return first - case.module.FIRST + 1 - plain.behind[first]


@pytest.mark.parametrize("settings", [{"share": 1.0}, {"share": 0.4, "enabled": False}], ids=["all", "off"])
@each
def test_leaving_out_nothing_leaves_the_whole_run_bit_identical(case, settings):
    plain = alone(case)
    gated, _ = run(case, **settings)
    assert plain.backwards == gated.backwards and same(plain.current, gated.current)
    assert (plain.structure, plain.steps, plain.happened) == (gated.structure, gated.steps, gated.happened)


# A scheduler gives this warning if it was copied with its optimizer, and the copy has not stepped yet.
@pytest.mark.filterwarnings("ignore:Seems like `optimizer.step:UserWarning")
@pytest.mark.parametrize("grows", [True, False], ids=["growing", "refining"])
@pytest.mark.parametrize("case", [case for case in LOOPS if case.resume], ids=lambda case: case.name)
def test_interrupted_and_resumed_leaves_out_the_same(case, grows, shortened, begun, short):
    settings = {"share": SHARE, "pause_iters": 0}
    whole, numbers = shortened(case)
    start, first, last = case.refined_from, case.module.FIRST, case.module.LAST
    there = [n for n in numbers if (first + 3 <= n < start - 3 if grows else last - 16 <= n < last)]
    if not there:
        pytest.skip("nothing grows in this script" if grows else "no iteration without pending gradients")
    new_log()
    begun.clear()
    trainer, train = case.make()
    with SkipGate(trainer, **settings) as one:
        checkpoint = train(last=there[0])
        state = json.loads(json.dumps(one.state_dict()))
    trainer, train = case.resume(checkpoint)
    with SkipGate(trainer, **settings) as other:
        other.load_state_dict(state)
        train()
    assert begun == numbers
    assert log.structure == whole.structure


@pytest.mark.parametrize("share", [0.4, "auto"])
@pytest.mark.parametrize(
    "case", [case for case in CASES if not case.leaves_out and case.name != "step_trainer"], ids=lambda case: case.name
)
def test_a_loop_that_cannot_be_shortened_is_refused_before_anything_runs(case, share, begun):
    trainer, _ = case.make()
    with pytest.raises(SkipGSError, match="cannot leave out whole iterations"):
        SkipGate(trainer, share=share)
    assert begun == []


def test_numbers_given_as_always_run_besides_those_of_conditions():
    case = next(case for case in LOOPS if case.name == "inria")
    (plain, _), (given, _) = (run(case, share=SHARE, always=always, pause_iters=0)[:2] for always in (None, [13, 37]))
    assert {13, 37} <= set(given.values) and not {13, 37} <= set(plain.values)
    assert given.structure == plain.structure
