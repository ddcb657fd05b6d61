"""skipgs.json: what a gated run did, for people and for comparisons."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from skipgs_plug.core.stats import GateStats

if TYPE_CHECKING:
    from skipgs_plug.core.gate import SkipGate

SCHEMA_VERSION = 1


def build_report(
    settings: dict[str, Any],
    stats: GateStats,
    floor: float | None,
    t_total: float,
    t_post: float,
    views: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return the content of skipgs.json.

    Returns:
        `schema_version` (1); `settings`; `iterations` (training backwards seen, run or skipped);
        `gated_iterations` (those from start_iter on, `backwards_run` + `backwards_skipped`);
        `min_bwd_ratio_effective` (floor in force, None for a policy without); `paused`, `non_finite`,
        `warm_up` (gated iterations by reason); `reasons` (all of them); `events` (structural changes by
        kind); `t_total`, `t_post` (seconds of training, and of its part from start_iter on); `views` (one row
        per view).
    """
    return {
        "schema_version": SCHEMA_VERSION,
        "settings": settings,
        "iterations": stats.iterations,
        "gated_iterations": stats.gated,
        "backwards_run": stats.backwards,
        "backwards_skipped": stats.skips,
        "min_bwd_ratio_effective": floor,
        "paused": stats.reasons.get("pause", 0),
        "non_finite": stats.reasons.get("non-finite", 0),
        "warm_up": stats.reasons.get("warm-up", 0),
        "reasons": dict(stats.reasons),
        "events": dict(stats.events),
        "t_total": t_total,
        "t_post": t_post,
        "views": views,
    }


def write_report(gate: SkipGate, path: str | Path) -> None:
    """Write `gate.report()` as JSON: aside first, then renamed, so that no half a file is ever seen."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        aside.write_text(json.dumps(_finite(gate.report()), indent=2, allow_nan=False) + "\n")
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def _finite(value: Any) -> Any:
    """JSON knows no NaN: a loss that is not finite is written as null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and value - value != 0.0:
        return None
    return value
