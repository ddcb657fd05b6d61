"""Means and spreads over seeds, one row per policy."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from skipgs_plug.bench.policies import REFERENCE
from skipgs_plug.bench.record import Point, RunRecord
from skipgs_plug.trainer.metrics import METRICS

HEADLINE = "psnr"  # metric of "time to reach"


@dataclass
class Quantity:
    """Mean and spread (sample standard deviation over seeds; None with one seed).

    Attributes:
        seeds: Number of seeds with a value; None if all have one.
    """

    mean: float
    spread: float | None
    seeds: int | None = None


@dataclass
class Row:
    """One policy over all its seeds.

    Attributes:
        seeds: Seeds that the means are taken over.
        excluded: The other seeds, with the reason.
        values: by name: `t_post t_total` (s), the same with `_wall` and `_processor`, `t_post_saved t_total_saved`
            (% less than the own run, same seed), `t_total_share` (% of its), `time_to_own` (s until the final PSNR of
            the own run, same seed, missing where it is not reached), `iterations_run`, `backwards_share` (% of the
            iterations of the full schedule), `share_forward ...` (% of the time that is compared), every metric by its
            own name, `train_` before it on training views, `_gain` after it above the own run, same seed; `num_GS`,
            `num_GS_share` (% of the own run's), `peak_memory_gib`; `wanted` and `held_back`: backwards after warm-up
            that a gate's rule asked for, and skips that its floor forbade (% of the iterations after warm-up).
    """

    policy: str
    seeds: list[int]
    excluded: dict[int, str] = field(default_factory=dict)
    values: dict[str, Quantity] = field(default_factory=dict)


def summarise(
    records: Sequence[RunRecord], policies: Sequence[str], full_iterations: int, whole: bool = False
) -> list[Row]:
    """Return one row per policy; runs, whole ones or refinements, that did not finish are named and enter no mean."""
    own = {r.seed: r for r in records if r.policy == REFERENCE and r.status == "done"}
    rows = []
    for policy in policies:
        mine = [record for record in records if record.policy == policy]
        done = [record for record in mine if record.status == "done"]
        row = Row(policy, [r.seed for r in done], {r.seed: f"{r.status}: {r.note}" for r in mine if r not in done})
        samples = [measured(record, own.get(record.seed), full_iterations, whole) for record in done]
        for name in dict.fromkeys(name for sample in samples for name in sample):
            row.values[name] = quantity([sample[name] for sample in samples if name in sample], len(samples))
        rows.append(row)
    return rows


def measured(record: RunRecord, own: RunRecord | None, full_iterations: int, whole: bool = False) -> dict[str, float]:
    """Return the quantities of one run. Differences to the own run need an own run of that seed."""
    values: dict[str, float] = {"t_post": record.t_post, "t_total": record.t_total}
    for name in ("t_post", "t_total"):
        values[f"{name}_wall"] = record.seconds[name]
        values[f"{name}_processor"] = record.seconds[f"{name}_processor"]
    if own is not None:
        values["t_post_saved"] = 100 * (1 - record.t_post / own.t_post) if own.t_post else 0.0
        values["t_total_saved"] = 100 * (1 - record.t_total / own.t_total)
        values["t_total_share"] = 100 * record.t_total / own.t_total
        reached = time_to_reach(record.points, own.metrics[HEADLINE])
        if reached is not None:
            values["time_to_own"] = reached
    values["iterations_run"] = record.iterations_run
    values["backwards_share"] = 100 * record.backwards / full_iterations
    for phase, seconds in record.phases.items():
        if phase == "strategy" and not whole:
            continue  # there is no densification in refinement
        values[f"share_{phase}"] = 100 * seconds / sum(record.phases.values())
    values.update(record.metrics)
    values.update({f"train_{name}": value for name, value in record.train_metrics.items() if name in METRICS})
    if own is not None:
        shared = [name for name in METRICS if name in record.metrics and name in own.metrics]
        values.update({f"{name}_gain": record.metrics[name] - own.metrics[name] for name in shared})
        values["num_GS_share"] = 100 * record.metrics["num_GS"] / own.metrics["num_GS"]
    after_warm_up = record.iterations_run - record.warm_up
    if "deviation" in record.reasons and after_warm_up > 0:
        held_back = record.reasons.get("budget", 0)
        values["wanted"] = 100 * (record.backwards - record.warm_up - held_back) / after_warm_up
        values["held_back"] = 100 * held_back / after_warm_up
    if record.peak_memory is not None:
        values["peak_memory_gib"] = record.peak_memory / 2**30
    return values


def time_to_reach(points: Sequence[Point], target: float) -> float | None:
    """Return the seconds until the held-out PSNR first reached `target` dB; None if it never did.

    PSNR is interpolated linearly in time between two evaluations.
    """
    before = points[0]
    for after in points:
        if after.metrics[HEADLINE] >= target:
            rise = after.metrics[HEADLINE] - before.metrics[HEADLINE]
            part = (target - before.metrics[HEADLINE]) / rise if rise > 0 else 1.0
            return before.seconds + part * (after.seconds - before.seconds)
        before = after
    return None


def quantity(sample: Sequence[float], total: int) -> Quantity:
    """Return mean and spread of a sample, which may have fewer values than the `total` number of seeds."""
    spread = statistics.stdev(sample) if len(sample) > 1 else None
    return Quantity(statistics.fmean(sample), spread, len(sample) if len(sample) < total else None)


def ceiling(rows: Sequence[Row]) -> dict[str, float] | None:
    """Return the largest possible saving at the gate's skip rate, in % of refinement time.

    A skipped iteration still runs forward pass, loss and decision. So no gate can save more than the share of backward
    and optimizer in the own run's time, times the share of skipped iterations.

    Returns:
        `share` (% of the own t_post in backward and optimizer), `skipped` (% of iterations), `most` (their
        product, %), `measured` (% saved); None without the rows of both.
    """
    by_name = {row.policy: row.values for row in rows if row.seeds}
    if "gate" not in by_name or REFERENCE not in by_name or "t_post_saved" not in by_name["gate"]:
        return None
    percent = by_name[REFERENCE]["share_backward"].mean + by_name[REFERENCE]["share_optimizer"].mean
    skipped = 100 - by_name["gate"]["backwards_share"].mean
    return {
        "share": percent,
        "skipped": skipped,
        "most": percent * skipped / 100,
        "measured": by_name["gate"]["t_post_saved"].mean,
    }


def timing_noise(records: Sequence[RunRecord]) -> float | None:
    """Return the largest difference of forward time per iteration within a seed, in %; None for single runs.

    Every policy renders the same views of nearly the same model, so the difference comes from the machine.
    """
    worst = None
    for seed in {record.seed for record in records}:
        rates = [r.phases["forward"] / r.iterations_run for r in records if r.seed == seed and r.status == "done"]
        if len(rates) > 1:
            worst = max(worst or 0.0, 100 * (max(rates) / min(rates) - 1))
    return worst


def row_as_dict(row: Row) -> dict[str, Any]:
    return {
        "policy": row.policy,
        "seeds": row.seeds,
        "excluded": row.excluded,
        "values": {name: dataclasses.asdict(quantity) for name, quantity in row.values.items()},
    }


def row_from_dict(content: dict[str, Any]) -> Row:
    values = {name: Quantity(**q) for name, q in content["values"].items()}
    return Row(content["policy"], content["seeds"], {int(k): v for k, v in content["excluded"].items()}, values)
