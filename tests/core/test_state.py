"""Saved states: the authors' version, damage, other versions."""

from __future__ import annotations

import copy
import json
import math
import warnings
from collections.abc import Iterator

import pytest
import torch

from skipgs_plug import SkipGate, SkipGSError
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.policy import SkipPolicy
from skipgs_plug.core.trainer_info import TrainerInfo

RELEASE = {
    "state_version": 1,
    "view_loss_ema": {0: 0.5, 7: 0.25},
    "stats": {"bwd": 600, "skip": 300},
    "min_bwd_ratio_effective": 0.65,
    "calibrated": True,
    "warmup_would_skip": 7,
    "warmup_would_total": 10,
    "accum_count": 0,
    "last_accum_norm": 0.0,
    "single_scale_ema": 2.0,
    "single_sq_ema": 4.0,
    "reference": 32.0,
    "step_count": 40,
}


def test_state_of_the_authors_controller_continues() -> None:
    policy = SkipPolicy(start_iter=100)
    policy.load_state_dict(RELEASE)
    assert policy.floor == 0.65
    assert (policy.budget.backwards, policy.budget.skips) == (600, 300)
    assert policy.decide(7, 0.2, 1000) == (True, "deviation")
    assert policy.decide(0, 0.6, 1001) == (False, "deviation")


def test_interrupted_release_warm_up_goes_on_where_theirs_would() -> None:
    policy = SkipPolicy(start_iter=100)
    policy.load_state_dict({**RELEASE, "calibrated": False, "stats": {"bwd": 50, "skip": 0}})
    assert policy.decide(7, 0.2, 599).reason == "warm-up"
    assert policy.decide(7, 0.2, 600).reason == "deviation"


def test_gate_loads_it_too() -> None:
    gate = SkipGate(start_iter=100)
    gate.load_state_dict(RELEASE)
    assert gate.stats()["backwards_skipped"] == 300
    assert not gate.backward(torch.tensor(0.2, requires_grad=True), view=7, step=1000)


def test_gate_state_is_plain_json_and_loads_weights_only(tmp_path) -> None:
    gate = SkipGate(start_iter=0, warmup=2)
    for step in range(10):
        gate.backward(torch.tensor(1.0, requires_grad=True), view=step % 3, step=step)
    state = gate.state_dict()
    assert json.loads(json.dumps(state)) == state
    torch.save(state, tmp_path / "gate.pt")
    assert torch.load(tmp_path / "gate.pt", weights_only=True) == state
    other = SkipGate(start_iter=0, warmup=2)
    other.load_state_dict(state)
    assert other.state_dict() == state


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda s: [], "is a dict, not list"),
        (lambda s: {}, "empty"),
        (lambda s: {**s, "version": 99}, "version 99"),
        (lambda s: {**s, "state_version": 2}, "version 2"),
        (lambda s: {k: v for k, v in s.items() if k != "clock"}, "lacks clock"),
        (lambda s: {**s, "stats": {}}, "lacks iterations"),
        (lambda s: {**s, "policy": {"version": 2}}, "lacks means"),
    ],
)
def test_damaged_states_are_named(damage, message: str) -> None:
    gate = SkipGate(start_iter=0)
    gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
    with pytest.raises(SkipGSError, match=message):
        gate.load_state_dict(damage(gate.state_dict()))


WRONG = (None, True, -1, 0.5, math.nan, "text", [], {}, ["text"], {"a": None}, {"a": ["text"]})


def entries(state: dict, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """The paths of all entries of a state."""
    for key, value in state.items():
        yield (*path, key)
        if isinstance(value, dict):
            yield from entries(value, (*path, key))


@pytest.mark.parametrize("kind", ["gate", "release", "refinement"])
def test_an_entry_that_is_missing_or_of_another_type_is_an_error_or_harmless(kind: str) -> None:
    """Every entry of a state is taken away once, and replaced by everything else once."""
    settings: dict = {"start_iter": 0} | ({"refine_share": 0.5} if kind == "refinement" else {})
    gate = SkipGate(**settings)
    for _step in gate.iterations(range(601)):
        gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
        break
    whole = RELEASE if kind == "release" else json.loads(json.dumps(gate.state_dict()))
    refused = 0
    for path in entries(whole):
        for wrong in (KeyError, *WRONG):
            state = copy.deepcopy(whole)
            parent = state
            for key in path[:-1]:
                parent = parent[key]
            if wrong is KeyError:
                del parent[path[-1]]
            else:
                parent[path[-1]] = wrong
            other = SkipGate(**settings)
            try:
                other.load_state_dict(state)
            except SkipGSError as error:
                refused += 1
                assert str(error).count(";") >= 1 and len(str(error)) < 300
                continue
            # A state that is accepted can be used, shown and saved.
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", RuntimeWarning)
                for step in other.iterations(range(600, 601)):
                    other.backward(torch.tensor(1.0, requires_grad=True), view="a", step=step)
            assert other.report() and other.summary() and other.state_dict()
    assert refused > len(WRONG) * 5


def test_ambiguous_view_keys_are_refused() -> None:
    policy = SkipPolicy(start_iter=0)
    policy.decide("6", 1.0, 0)
    policy.means.values[6] = 1.0
    with pytest.raises(SkipGSError, match="same text"):
        policy.state_dict()


def resumed(
    factor: float, *, before: bool = False, event: bool = False, share: float | None = None, steps: int = 40
) -> SkipGate:
    """A gate that learnt means of 1 and goes on with losses of `factor`; with an event before it is saved or after."""
    settings: dict = {"start_iter": 0, **({"warmup": 2} if share is None else {"refine_share": share})}
    first = SkipGate(**settings)
    for step in first.iterations(range(100)):  # with a share, the first iterations run
        if step == 20:
            break
        first.backward(torch.tensor(1.0, requires_grad=True), view=step % 3, step=step)
    if before:
        first.notify_event("opacity reset")
    gate = SkipGate(**settings)
    gate.load_state_dict(first.state_dict())
    if event:
        gate.notify_event("prune")
    for step in gate.iterations(range(20, 100)):
        if step == 20 + steps:
            break
        gate.backward(torch.tensor(factor, requires_grad=True), view=step % 3, step=step)
    return gate


@pytest.mark.parametrize("share", [None, 0.5])
@pytest.mark.parametrize("factor", [9.0, 0.1])
def test_losses_far_from_all_means_are_another_scenes(factor: float, share: float | None) -> None:
    resumed(factor, share=share, steps=9)
    with pytest.warns(RuntimeWarning, match="released .*another scene: up to iteration 29 each of 10 losses"):
        gate = resumed(factor, share=share)
    assert gate.released is not None


def test_losses_near_their_means_or_after_an_event_pass() -> None:
    for factor in (0.6, 1.9):
        resumed(factor)
    resumed(9.0, event=True)
    resumed(9.0, before=True)
    resumed(9.0, before=True, share=0.5)


def test_a_state_of_the_authors_controller_has_no_refinement() -> None:
    with (
        SkipGate(start_iter=0, refine_share=0.4) as gate,
        pytest.raises(SkipGSError, match=r"with no share, not refine_share=0\.4"),
    ):
        gate.load_state_dict(RELEASE)


def test_a_loaded_state_is_handed_on_until_the_trainer_says_when_densification_ends() -> None:
    state = resumed(1.0).state_dict()
    engine = Engine(SkipConfig(warmup=2))
    assert engine.state_dict() == {}
    engine.load_state_dict(state)
    assert engine.state_dict() == state
    engine.configure(TrainerInfo(start_iter=0))
    assert engine.state_dict()["policy"] == state["policy"]


def test_nothing_but_a_state_is_loaded() -> None:
    for wrong in (None, [], "state", 3):
        with pytest.raises(SkipGSError, match="state"):
            SkipGate(start_iter=0).load_state_dict(wrong)  # type: ignore[arg-type]


def test_a_state_from_before_shares_were_looked_at_has_seen_no_step() -> None:
    gate = SkipGate(start_iter=0, warmup=2)
    gate.backward(torch.tensor(1.0, requires_grad=True), view="a", step=0)
    state = gate.state_dict()
    del state["visibility"], state["pace"], state["size_bound"]
    gate = SkipGate(start_iter=0, warmup=2)
    gate.load_state_dict(state)
    assert gate.state_dict()["visibility"] == [0.0, 0.0, 0, 0.0, 0.0]
    gate.load_state_dict({**state, "shown": [1.5, 3]})  # a version without unread sums
    assert gate.state_dict()["visibility"] == [1.5, 3.0, 3, 0.0, 0.0]
