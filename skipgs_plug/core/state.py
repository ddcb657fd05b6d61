"""Saved states: versions, and the one of the authors' controller."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.core.errors import SkipGSError

POLICY_VERSION = 2
GATE_VERSION = 2
POLICY_KEYS = ("means", "budget", "warmup_end", "pause_until", "events")
GATE_KEYS = ("policy", "stats", "accumulator", "non_finite_in_a_row", "clock", "step")
STATS_KEYS = ("iterations", "backwards", "skips", "reasons", "events", "views")
REFINEMENT_KEYS = ("asked", "share", "first", "next", "thinning", "recovery", "foresight")
BUDGET_KEYS = ("floor", "backwards", "skips", "calibrating", "would_skip", "would_total")


def is_release_state(state: Mapping[str, Any]) -> bool:
    """Whether the authors' controller wrote this state."""
    return "state_version" in state


def policy_state(state: Mapping[str, Any], release_warmup_end: int) -> dict[str, Any]:
    """Check a policy state and bring it to the present version.

    Args:
        state: As saved by `SkipPolicy.state_dict`, or by the authors' controller (`state_version` 1).
        release_warmup_end: Iteration at which the authors' warm-up ends; their state does not hold it.

    Raises:
        SkipGSError: Another version, or something is missing.
    """
    if is_release_state(state):
        state = _from_release(state, release_warmup_end)
    require_version(state, POLICY_VERSION)
    require(state, POLICY_KEYS, "Gate state")
    require(state["budget"], BUDGET_KEYS, "Gate state's budget")
    return dict(state)


def gate_state(state: Mapping[str, Any]) -> dict[str, Any]:
    """Check the state of a whole gate, as saved by `SkipGate.state_dict`.

    Raises:
        SkipGSError: Another version, or something is missing.
    """
    require_version(state, GATE_VERSION)
    require(state, GATE_KEYS, "Gate state")
    require(state["stats"], STATS_KEYS, "Gate state's stats")
    if state.get("refinement") is not None:
        require(state["refinement"], REFINEMENT_KEYS, "Gate state's refinement")
    return dict(state)


def require_version(state: Mapping[str, Any], expected: int) -> None:
    """Raise SkipGSError that names the version of a state when it is another."""
    version = state.get("version")
    if version != expected:
        raise SkipGSError(f"Gate state has version {version!r}, expected {expected}; start the gate afresh.")


def require(state: Mapping[str, Any], keys: tuple[str, ...], what: str) -> None:
    """Raise SkipGSError that names what is missing from a state."""
    missing = [key for key in keys if key not in state]
    if missing:
        raise SkipGSError(f"{what} lacks {', '.join(missing)}: it is damaged; start the gate afresh.")


def _from_release(state: Mapping[str, Any], warmup_end: int) -> dict[str, Any]:
    version = state["state_version"]
    if version != 1:
        raise SkipGSError(f"State of the authors' controller has version {version!r}; only 1 can be loaded.")
    keys = ("view_loss_ema", "stats", "min_bwd_ratio_effective", "calibrated")
    require(state, (*keys, "warmup_would_skip", "warmup_would_total"), "State of the authors' controller")
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
