"""The rule: reference traces of the authors' controller, and properties of any stream of losses."""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from skipgs_plug import SkipGate
from skipgs_plug.core import decision
from skipgs_plug.core.budget import MIN_SAMPLES
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.policy import SkipPolicy

VIEWS = [f"v{i}" for i in range(4)]
STREAM = st.lists(st.tuples(st.sampled_from(VIEWS), st.floats(1e-4, 1.0)), min_size=1, max_size=400)


def run(policy: SkipPolicy, stream, first: int = 0) -> list:
    return [policy.decide(view, loss, first + i) for i, (view, loss) in enumerate(stream)]


def test_decides_as_the_authors_controller(shared: Path) -> None:
    for case in json.loads((shared / "reference" / "gate_traces.json").read_text()):
        policy = SkipPolicy(start_iter=case["start_step"], **case["policy"])
        decisions = run(policy, zip(case["view"], case["loss"], strict=True), case["first_step"])
        assert "".join("1" if d.skip else "0" for d in decisions) == case["skip"], case["name"]
        assert policy.means.state_dict() == case["ema"]
        assert policy.budget.backwards == case["summary"]["total_bwd"]
        assert policy.budget.skips == case["summary"]["total_skip"]
        assert policy.floor == case["summary"]["min_bwd_ratio_final"]


def test_traces_survive_an_interruption_anywhere(shared: Path) -> None:
    case = json.loads((shared / "reference" / "gate_traces.json").read_text())[0]
    stream = list(zip(case["view"], case["loss"], strict=True))
    for cut in (500, 999, 1000, 1001, 1300, 1499, 1500, 1501, 2500):
        first, second = SkipPolicy(start_iter=1000), SkipPolicy(start_iter=1000)
        decisions = run(first, stream[:cut], 1)
        second.load_state_dict(json.loads(json.dumps(first.state_dict())))
        decisions += run(second, stream[cut:], 1 + cut)
        assert "".join("1" if d.skip else "0" for d in decisions) == case["skip"]


@given(STREAM, st.floats(0.0, 1.0), st.integers(0, 30))
def test_the_floor_holds(stream, ratio: float, warmup: int) -> None:
    backwards = 0
    policy = SkipPolicy(start_iter=0, warmup=warmup, min_bwd_ratio=ratio)
    for recorded, (view, loss) in enumerate(stream):
        affordable = recorded <= MIN_SAMPLES or backwards / recorded >= ratio
        decision = policy.decide(view, loss, recorded)
        assert affordable or not decision.skip
        backwards += not decision.skip


@given(STREAM, st.integers(0, 50))
def test_warm_up_and_unseen_views_never_skip(stream, warmup: int) -> None:
    policy = SkipPolicy(start_iter=5, warmup=warmup, min_bwd_ratio=0.0)
    seen: set[str] = set()
    for i, (view, loss) in enumerate(stream):
        decision = policy.decide(view, loss, i)
        if i < 5:
            assert decision.reason == "inactive"
            continue
        if i - 5 < warmup:
            assert decision == (False, "warm-up")
        elif view not in seen:
            assert decision == (False, "new view")
        seen.add(view)


@given(STREAM, st.data())
def test_saved_and_loaded_is_uninterrupted(stream, data) -> None:
    cut = data.draw(st.integers(0, len(stream)))
    event = data.draw(st.integers(0, len(stream)))

    def decide(policy: SkipPolicy, begin: int, end: int) -> list:
        answers = []
        for i in range(begin, end):
            if i == event:
                policy.notify_event(i, len(VIEWS))
            answers.append(policy.decide(*stream[i], i))
        return answers

    settings = {"start_iter": 10, "warmup": 20, "pause_iters": 15}
    whole = SkipPolicy(**settings)
    first, second = SkipPolicy(**settings), SkipPolicy(**settings)
    expected = decide(whole, 0, len(stream))
    got = decide(first, 0, cut)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert got + decide(second, cut, len(stream)) == expected
    assert second.state_dict() == whole.state_dict()


@given(STREAM)
def test_skips_exactly_at_or_below_the_mean(stream) -> None:
    policy = SkipPolicy(start_iter=0, warmup=0, min_bwd_ratio=0.0)
    means: dict[str, float] = {}
    for i, (view, loss) in enumerate(stream):
        decision = policy.decide(view, loss, i)
        if view in means:
            assert decision.skip == (loss / (means[view] + 1e-8) <= 1.0)
            means[view] = 0.95 * means[view] + (1.0 - 0.95) * loss
        else:
            means[view] = loss


def test_auto_floor_follows_warm_up() -> None:
    policy = SkipPolicy(start_iter=0, warmup=5)
    for step, loss in enumerate([1.0, 0.9, 2.0, 0.9, 2.0]):
        policy.decide("a", loss, step)
    assert policy.floor == 0.5
    policy.decide("a", 0.5, 5)
    assert policy.floor == 1.0 - 0.5 * (2 / 4)


def test_a_floor_that_was_given_stays() -> None:
    policy = SkipPolicy(start_iter=0, warmup=5, min_bwd_ratio=0.1)
    for step in range(20):
        policy.decide("a", 1.0, step)
    assert policy.floor == 0.1


def test_a_gate_without_a_trainer_begins_where_its_policy_does() -> None:
    gate = SkipGate(policy=SkipPolicy(start_iter=5, warmup=0))
    for step in range(9):
        gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=step)
    assert gate.stats()["backwards_run"] + gate.stats()["backwards_skipped"] == 4


def test_auto_floor_stays_without_repeated_views_in_warm_up() -> None:
    policy = SkipPolicy(start_iter=0, warmup=3)
    for step in range(10):
        policy.decide(f"v{step}", 1.0, step)
    assert policy.floor == 0.5


def test_threshold_raises_the_bar() -> None:
    policy = SkipPolicy(start_iter=0, warmup=0, threshold=0.1, min_bwd_ratio=0.0)
    policy.decide("a", 1.0, 0)
    assert policy.decide("a", 1.09, 1).skip
    assert not policy.decide("a", 1.2, 2).skip


def test_disabled_records_nothing() -> None:
    policy = SkipPolicy(start_iter=0, warmup=0, enabled=False)
    before = policy.state_dict()
    assert {policy.decide("a", 1.0, step) for step in range(5)} == {(False, "inactive")}
    assert policy.state_dict() == before


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_non_finite_losses_leave_no_trace(poison: float) -> None:
    policy = SkipPolicy(start_iter=0, warmup=0)
    policy.decide("a", 1.0, 0)
    before = policy.state_dict()
    assert policy.decide("a", poison, 1) == (True, "non-finite")
    assert policy.state_dict() == before


def test_event_pauses_without_recording() -> None:
    policy = SkipPolicy(start_iter=0, warmup=0, min_bwd_ratio=0.0, pause_iters=10)
    policy.decide("a", 1.0, 0)
    policy.notify_event(0, n_views=1)
    before = policy.budget.state_dict(), policy.means.state_dict()
    assert Counter(policy.decide(v, 9.0, s).reason for s, v in enumerate("ab" * 5, start=1)) == {"pause": 10}
    assert (policy.budget.state_dict(), policy.means.state_dict()) == before
    # The mean is the old one: the losses of the peak neither changed it nor seeded a new one.
    assert policy.decide("a", 0.9, 11).skip
    assert policy.decide("b", 0.9, 12).reason == "new view"


def test_event_in_warm_up_postpones_the_rest_of_it() -> None:
    policy = SkipPolicy(start_iter=0, warmup=4, pause_iters=6)
    reasons = []
    for step in range(14):
        reasons.append(policy.decide("a", 1.0, step).reason)
        if step == 1:
            policy.notify_event(step, 1)
    assert reasons == ["warm-up"] * 2 + ["pause"] * 6 + ["warm-up"] * 2 + ["deviation"] * 4


def test_events_of_densification_do_not_pause() -> None:
    policy = SkipPolicy(start_iter=100, warmup=0)
    policy.notify_event(98, 1)
    assert policy.decide("a", 1.0, 100).reason == "new view"
    policy = SkipPolicy(start_iter=100, warmup=0)
    policy.notify_event(99, 1)
    assert policy.decide("a", 1.0, 100).reason == "pause"


def test_warm_up_counts_from_the_first_gated_iteration_seen() -> None:
    policy = SkipPolicy(start_iter=100, warmup=3)
    reasons = [policy.decide("a", 1.0, step).reason for step in range(900, 906)]
    assert reasons == ["warm-up"] * 3 + ["deviation"] * 3


@pytest.mark.parametrize(
    ("loss", "answer", "counted"),
    [
        (0.5, decision.OTHER_RANK, (2, 0)),  # a skip became a backward
        (0.5, decision.NON_FINITE, (1, 0)),  # the loss of another process is not finite, so neither count rises
        (2.0, decision.NON_FINITE, (1, 0)),
    ],
)
def test_what_the_processes_agreed_on_counts(loss: float, answer: decision.Decision, counted: tuple[int, int]) -> None:
    policy = SkipPolicy(start_iter=0, warmup=0)
    policy.decide("a", 1.0, 0)
    own = policy.decide("a", loss, 1)
    policy.overrule(own, answer)
    assert (policy.budget.backwards, policy.budget.skips) == counted


def test_what_was_not_counted_is_not_taken_back() -> None:
    policy = SkipPolicy(start_iter=10, warmup=0)
    policy.overrule(policy.decide("a", 1.0, 0), decision.NON_FINITE)
    policy.notify_event(10, 1)
    policy.overrule(policy.decide("a", 1.0, 11), decision.NON_FINITE)
    assert (policy.budget.backwards, policy.budget.skips) == (0, 0)


@pytest.mark.parametrize("view", [3, "3"])
def test_view_keys_survive_as_text(view) -> None:
    first, second = SkipPolicy(start_iter=0, warmup=0), SkipPolicy(start_iter=0, warmup=0)
    first.decide(view, 1.0, 0)
    second.load_state_dict(json.loads(json.dumps(first.state_dict())))
    assert second.decide(view, 0.5, 1) == first.decide(view, 0.5, 1) == (True, "deviation")


def test_refuses_to_start_nowhere() -> None:
    with pytest.raises(SkipGSError, match="start_iter"):
        SkipPolicy(start_iter=None)  # type: ignore[arg-type]
