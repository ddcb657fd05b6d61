"""Saved states: their content, their versions, and the state of the authors' controller."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any, TypedDict

from skipgs_plug import schema
from skipgs_plug.core.errors import GateStateError, SkipGSError

# Versions of the two formats of state. Version 1 of the policy's is that of the authors' controller.
POLICY_VERSION = 2
GATE_VERSION = 2


class BudgetState(TypedDict):
    """Content of `BackwardBudget.state_dict()`."""

    floor: float
    backwards: int
    skips: int
    calibrating: bool
    would_skip: int
    would_total: int


class PolicyState(TypedDict):
    """Content of `SkipPolicy.state_dict()`."""

    version: int
    means: dict[Any, float]
    budget: BudgetState
    warmup_end: int | None
    pause_until: int
    events: int


class RefinementPolicyState(TypedDict):
    """Content of `RefinementPolicy.state_dict()`."""

    means: dict[Any, float]


class StatsState(TypedDict):
    """Content of `GateStats.state_dict()`; the row of a view is visits, backwards, skips, last loss."""

    iterations: int
    backwards: int
    skips: int
    reasons: dict[str, int]
    events: dict[str, int]
    views: dict[str, tuple[int, int, int, Real]]


class ClockState(TypedDict):
    """Content of `GateClock.state_dict()`."""

    t_total: float
    t_post: float
    t_total_processor: float
    t_post_processor: float


class NewerSamplingState(TypedDict, total=False):
    """Entry that states of earlier versions do not have."""

    since: tuple[int, int]


class SamplingState(NewerSamplingState):
    """Content of `Sampling.state_dict()`."""

    share: float
    run: int
    left_out: int
    due: int


class EarlyStoppingState(TypedDict):
    """Content of `EarlyStopping.state_dict()`."""

    ends: list[float]
    cycle: int
    ended: bool
    gains: list[tuple[float, float]]
    foreseen: float | None
    now: dict[str, float]
    before: dict[str, float]


class NewerRefiningState(TypedDict, total=False):
    """Entries that states of earlier versions do not have."""

    changed: int | None
    expected: int | None
    late_change: tuple[int, int]
    ran_for: dict[str, int]


class RefiningState(NewerRefiningState):
    """Content of `Refining.state_dict()`."""

    asked: float | str
    share: float | None
    first: int | None
    sampling: SamplingState
    watched: list[str]
    recovery: tuple[int, int]
    stopping: EarlyStoppingState | None


class NewerEventsState(TypedDict, total=False):
    """Entry that states of earlier versions do not have."""

    gaussians: tuple[int, int]


class EventsState(NewerEventsState):
    """Content of `DensificationEvents.state_dict()`."""

    kept: int
    left_out: int
    behind: int


class NewerGrowingState(TypedDict, total=False):
    """Entries that states of earlier versions do not have."""

    share_now: float | None
    gaussians_at_first: int


class GrowingState(NewerGrowingState):
    """Content of `Growing.state_dict()`."""

    asked: float | str
    share: float | None
    first: int | None
    gaussians_shown: tuple[float | None, float | None]  # first and latest measured share
    measuring: bool
    sampling: SamplingState
    events: EventsState | None


class NewerPaceState(TypedDict, total=False):
    """Entry that states of earlier versions do not have."""

    grow_asked: float | str | None


class PaceState(NewerPaceState):
    """Content of `Phased.state_dict()`."""

    start: int
    last: int | None
    keeps_rates: bool
    next: int | None
    required: list[int]
    refining: RefiningState
    growing: GrowingState | None


class GateState(TypedDict):
    """Content of `SkipGate.state_dict()`; each policy has its own part, and checks it."""

    version: int
    policy: dict[str, Any]
    stats: StatsState
    non_finite_in_a_row: int
    clock: ClockState
    step: int | None
    pace: PaceState | None
    visibility: tuple[float, float, int, float, float]  # content of `Visibility.state_dict()`
    size_bound: float | None  # content of `SizeBound.state_dict()`


class ReleaseStats(TypedDict):
    """Counts of the authors' controller."""

    bwd: int
    skip: int


class ReleaseState(TypedDict):
    """State of the authors' controller, `state_version` 1."""

    view_loss_ema: dict[Any, float]
    stats: ReleaseStats
    min_bwd_ratio_effective: float
    calibrated: bool
    warmup_would_skip: int
    warmup_would_total: int


def is_release_state(state: Mapping[str, Any]) -> bool:
    """Whether the authors' controller wrote this state."""
    return "state_version" in state


def policy_state(state: Mapping[str, Any], release_warmup_end: int) -> dict[str, Any]:
    """Check a policy state and convert it to the present version.

    Args:
        state: State of `SkipPolicy.state_dict`, or of the authors' controller (`state_version` 1).
        release_warmup_end: Iteration at which the authors' warm-up ends; their state does not contain it.

    Raises:
        SkipGSError: The version differs, or an entry is missing or has another type.
    """
    require_state(state)
    if is_release_state(state):
        state = _from_release(state, release_warmup_end)
    _require_version(state, POLICY_VERSION)
    _require(state, PolicyState, "policy")
    return dict(state)


def refinement_policy_state(state: Mapping[str, Any]) -> Mapping[str, Any]:
    """Check the state of a `RefinementPolicy`.

    Raises:
        SkipGSError: An entry is missing or has another type.
    """
    _require(state, RefinementPolicyState, "policy")
    return state


def gate_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Check the state of a whole gate, saved by `SkipGate.state_dict` or by the authors' controller.

    Raises:
        SkipGSError: The version differs, or an entry is missing or has another type.
    """
    require_state(state)
    accumulator = state.get("accumulator") or {}
    if accumulator.get("norm_mean") is not None:
        raise GateStateError(
            'The gate state was saved with step_mode="adaptive_norm", which no longer exists; start the gate afresh.'
        )
    if is_release_state(state):
        _require_release_version(state)
        _require(state, ReleaseState, "state")
    else:
        _require_version(state, GATE_VERSION)
        if state.get("refinement") is not None:
            raise GateStateError(
                "The gate state was saved by a version before 0.2.0, which left out iterations in another way; "
                "continue with that version, or start the gate afresh."
            )
        # Complete states of earlier versions: at first no iterations were left out, and nothing was measured.
        state = {"pace": None, "size_bound": None, **state}
        visibility = state.setdefault("visibility", state.pop("shown", [0.0, 0]))  # the entry was called "shown"
        if isinstance(visibility, (list, tuple)) and len(visibility) == 2:  # sums were never unread
            state["visibility"] = [*visibility, visibility[1], 0.0, 0.0]
        if isinstance(state.get("clock"), Mapping):  # processor seconds were not counted
            state["clock"] = {"t_total_processor": math.nan, "t_post_processor": math.nan, **state["clock"]}
        _require(state, GateState, "state")
    return dict(state)


def require_state(state: Any) -> None:
    """Raise SkipGSError unless this is a dictionary with entries."""
    if not isinstance(state, Mapping):
        raise GateStateError(f"A gate state is a dict, not {type(state).__name__}; start the gate afresh.")
    if not state:
        raise SkipGSError("The gate state is empty: it was saved before training began; start afresh.")


def _require_version(state: Mapping[str, Any], expected: int) -> None:
    version = state.get("version")
    if version != expected:
        raise GateStateError(f"Gate state has version {version!r}, expected {expected}; start the gate afresh.")


def _require_release_version(state: Mapping[str, Any]) -> None:
    version = state["state_version"]
    if version != 1:
        raise SkipGSError(f"State of the authors' controller has version {version!r}; only 1 can be loaded.")


def _require(state: Mapping[str, Any], kind: type, name: str) -> None:
    try:
        schema.check(state, kind, name)
    except schema.SchemaError as error:
        raise GateStateError(f"Gate state is damaged ({error}); start the gate afresh.") from error


def _from_release(state: Mapping[str, Any], warmup_end: int) -> dict[str, Any]:
    _require_release_version(state)
    _require(state, ReleaseState, "state")
    return {
        "version": POLICY_VERSION,
        "means": state["view_loss_ema"],
        "budget": {
            "floor": state["min_bwd_ratio_effective"],
            "backwards": state["stats"]["bwd"],
            "skips": state["stats"]["skip"],
            "calibrating": not state["calibrated"],
            "would_skip": state["warmup_would_skip"],
            "would_total": state["warmup_would_total"],
        },
        # Before the first recorded iteration warm-up has not begun.
        "warmup_end": warmup_end if state["stats"]["bwd"] else None,
        "pause_until": 0,
        "events": 0,
    }
