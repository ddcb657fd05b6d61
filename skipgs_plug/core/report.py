"""skipgs.json: the report of a gated run, for people and for comparisons."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Protocol

from skipgs_plug.core.clock import Times
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.pace.phase import NAMED_FOR_TRAINER
from skipgs_plug.core.stats import GateStats
from skipgs_plug.files import write_aside

SCHEMA_VERSION = 1  # version of the format of skipgs.json
# The entries of skipgs.json about whole iterations, for a gate that leaves out none.
NO_REFINEMENT: dict[str, Any] = {
    "refine_share": None,
    "gaussians_shown": None,
    "iterations_skipped": 0,
    "ran_for": {},
    "always_run": {},
    "early_stopping": None,
    "growing": None,
}


class Reporting(Protocol):
    """An object with a report: a `SkipGate`."""

    def report(self) -> dict[str, Any]: ...


def counters(
    stats: GateStats,
    floor: float | None,
    times: Times,
    left_out: dict[str, Any] | None = None,
    released: str | None = None,
) -> dict[str, Any]:
    """Return counters and times.

    Args:
        stats: Counts of the gate.
        floor: Least share of backward passes that must run; None if the policy has no floor.
        times: Seconds of training.
        left_out: Result of `Pace.report`; None if no iteration is left out.
        released: Why the gate released the run; None if it did not.

    Returns:
        `released` (the argument; the counters are those until then); `iterations` (training backward passes seen, run
        or skipped); `gated_iterations` (backward passes seen from start_iter on, which is `backwards_run` +
        `backwards_skipped`); `min_bwd_ratio_effective` (floor in force; None if the policy has no floor); `paused`,
        `non_finite` (gated iterations with that reason); `reasons` (gated iterations by reason); `events` (structural
        changes by kind); `t_total`, `t_post` (seconds of all iterations, and of the iterations from start_iter on),
        `t_total_processor`, `t_post_processor` (the same in processor seconds, see `Times`); `refine_share` (share of
        the iterations from start_iter on that run or may run; None if no iteration is left out), `gaussians_shown`
        (share of the Gaussians that a view shows; None if unknown), `iterations_run`, `iterations_skipped`, `ran_for`,
        `always_run`, `early_stopping` (see `Refining.report`), `growing` (see `Growing.report`; None if all iterations
        before the end of densification run).
    """
    return {
        "released": released,
        "iterations": stats.iterations,
        "gated_iterations": stats.gated,
        "backwards_run": stats.backwards,
        "backwards_skipped": stats.skips,
        "min_bwd_ratio_effective": floor,
        "paused": stats.reasons.get("pause", 0),
        "non_finite": stats.reasons.get("non-finite", 0),
        "reasons": dict(stats.reasons),
        "events": dict(stats.changes),
        **times._asdict(),
        **(left_out or {**NO_REFINEMENT, "iterations_run": stats.gated}),
    }


def build_report(settings: dict[str, Any], counted: dict[str, Any], views: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the content of skipgs.json: `schema_version` (1), `settings`, all counters, `views` (one row each).

    Args:
        settings: Settings in force, and the name of the adapter.
        counted: Result of `counters`.
        views: Result of `GateStats.view_table`.
    """
    return {"schema_version": SCHEMA_VERSION, "settings": settings, **counted, "views": views}


def summarise(config: SkipConfig, counted: dict[str, Any]) -> str:
    """Return the counters as a few lines for people.

    Args:
        config: Settings in force.
        counted: Result of `counters`.
    """
    if not config.enabled:
        return f"SkipGS: off, {counted['iterations']:,} backwards seen."
    if counted["released"] is not None:
        left_out = counted["iterations_skipped"] + (counted["growing"] or {}).get("iterations_skipped", 0)
        return (
            f"SkipGS: {counted['iterations']:,} iterations seen, {counted['backwards_skipped']:,} backwards skipped, "
            f"{left_out:,} iterations left out whole.\n  {counted['released']}"
        )
    if config.leaves_out:
        return _summarise_refinement(config, counted)
    gated, skipped, reasons = counted["gated_iterations"], counted["backwards_skipped"], counted["reasons"]
    floor = counted["min_bwd_ratio_effective"]
    percent = 100 * skipped / gated if gated else 0.0
    return (
        f"SkipGS: {skipped:,} of {gated:,} backwards skipped ({percent:.1f} %) since iteration "
        f"{config.start_iter or 0:,}, {counted['iterations']:,} iterations in all.\n"
        f"  floor {'none' if floor is None else format(floor, '.3f')}, warm-up {reasons.get('warm-up', 0):,}, "
        f"held back by the floor {reasons.get('budget', 0):,}, paused {counted['paused']:,} "
        f"(changes {sum(counted['events'].values()):,}), non-finite {counted['non_finite']:,}"
    )


def _summarise_refinement(config: SkipConfig, counted: dict[str, Any]) -> str:
    run, skipped = counted["iterations_run"], counted["iterations_skipped"]
    start = config.start_iter or 0
    lines = [] if counted["growing"] is None else [_summarise_growing(counted["growing"], ended=not run + skipped)]
    if not run + skipped:
        return "\n".join([*lines, f"SkipGS: no iteration of refinement, which begins at iteration {start:,}."])
    percent = 100 * run / (run + skipped)
    lines += [
        f"SkipGS: {run:,} of {run + skipped:,} iterations run ({percent:.1f} %) since iteration {start:,}, "
        f"{skipped:,} left out whole."
    ]
    if counted["non_finite"]:
        backward = "ran all the same" if config.on_nonfinite == "pass" else "was skipped"
        lines.append(f"  in {counted['non_finite']:,} of them the loss was not finite, and the backward {backward}")
    if counted["gaussians_shown"] is not None and config.compensates:
        lines.append(
            f"  each view shows {100 * counted['gaussians_shown']:.0f} % of the Gaussians; this share sets the "
            "length of the steps"
        )
    wanted, ran_for = counted["refine_share"], counted["ran_for"]
    others = ran_for["conditions"] + ran_for["changes"]
    # The last iteration is one of the others, and the iterations of the share come first, also in a run that was ended.
    if wanted is not None and others > 1 and run > wanted * (run + skipped) + 2:
        lines.append(
            f"  this is more than the share of {wanted:.2f}: {ran_for['share']:,} ran for the share, "
            f"{ran_for['conditions']:,} for conditions of the loop, "
            f"{ran_for['changes']:,} after prunes and resets at the end of refinement "
            f"({sum(counted['events'].values()):,} changes in all)"
        )
    stopping = counted["early_stopping"]
    if stopping is not None and not stopping["watched"]:
        why = stopping["why_none_watched"]
        lines.append(f"  the whole share runs, because no view is watched{'' if why is None else f': {why}'}")
    elif stopping is not None:
        worth = stopping["rest_worth_db"]
        judged = "was not estimated" if worth is None else f"could gain at most {worth:.2f} dB at the last check"
        lines.append(
            f"  {'ended early' if stopping['ended_early'] else 'not ended early'}, in cycle {stopping['cycle'] + 1}; "
            f"the rest {judged} (tolerance {config.tolerance} dB, {len(stopping['watched'])} views watched)"
        )
    elif config.refine_share == "auto" and not skipped:
        lines.append("  all iterations run: refinement is too short, or views come up too seldom, to leave some out")
    return "\n".join(lines)


def _summarise_growing(growing: dict[str, Any], ended: bool) -> str:
    """Return the lines about the growing phase; `ended` says that the run ended in it, as after Ctrl-C."""
    run, skipped = growing["iterations_run"], growing["iterations_skipped"]
    percent = 100 * run / (run + skipped) if run + skipped else 100.0
    factor = growing["rate_factor"]
    longer = "" if factor is None or factor == 1.0 else f", steps {factor:.1f} times as long"
    return (
        f"SkipGS: {run:,} of {run + skipped:,} iterations run ({percent:.1f} %) while the scene grows, with "
        f"{growing['events_run']:,} of {growing['events_run'] + growing['events_skipped']:,} densification "
        f"events{longer}.{_why_more(growing, ended)}{_random_points(growing)}{_half_size(growing)}"
    )


def _random_points(growing: dict[str, Any]) -> str:
    """Return a line about random points; empty if the scene did not begin with them."""
    if not growing["random_points"]:
        return ""
    fade = "the points that the scene began with fade, as random ones do"
    return f"\n  {fade if growing['fading'] else 'the scene began with random points'}; this needs more iterations"


def _half_size(growing: dict[str, Any]) -> str:
    """Return a line about photographs of half the size; empty if there were none."""
    until, psnr, ssim = (growing[f"half_size_{key}"] for key in ("until", "psnr", "ssim"))
    if not until:
        return ""
    kept = "" if psnr is None else f", because they keep {psnr:.1f} dB and an SSIM of {ssim:.3f} at that size"
    return f"\n  photographs had half their size until iteration {until:,}{kept}"


def _why_more(growing: dict[str, Any], ended: bool) -> str:
    """Return a line that says why more than the share of the growing phase ran; empty if it did not."""
    run, asked = growing["iterations_run"], growing["iterations_run"] + growing["iterations_skipped"]
    times = growing["times_grown"]
    if growing["share"] is not None and 0 < asked <= growing["always_run"].get(NAMED_FOR_TRAINER, 0):
        return "\n  all of them run: this trainer needs them (docs/adapters.md), or they were named"
    if growing["share"] is None or times is None or run <= 1.1 * growing["share"] * asked or times <= 1.0:
        return ""
    early = ", or because the run ended early" if ended else ""
    return (
        f"\n  this is more than the share of {growing['share']:.2f}, because the scene grew to {times:.1f} times its "
        f"Gaussians, or because conditions of the loop need iterations{early}"
    )


def write_report(gate: Reporting, path: str | Path, **more: Any) -> None:
    """Write the report of a gate as JSON.

    Args:
        gate: A `SkipGate`.
        path: The file.
        **more: Entries of the trainer's own.
    """
    text = json.dumps(_finite({**gate.report(), **more}), indent=2, allow_nan=False) + "\n"
    with write_aside(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _finite(value: Any) -> Any:
    """Replace non-finite numbers by None, because JSON has no NaN and no infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    if isinstance(value, float) and value - value != 0.0:
        return None
    return value
