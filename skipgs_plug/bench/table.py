"""The tables, and the sentences that belong under them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug.bench.policies import POLICIES
from skipgs_plug.bench.summary import Row
from skipgs_plug.trainer.clock import PHASES
from skipgs_plug.trainer.metrics import METRICS, Metric


@dataclass(frozen=True)
class Column:
    """A column: heading, name in `Row.values`, digits after the point, sign shown or not, text without a value."""

    heading: str
    name: str
    digits: int
    signed: bool = False
    absent: str = "-"


def metric_columns(metric: Metric) -> tuple[Column, Column]:
    """Return the held-out value and its difference to ungated."""
    gain = Column(f"vs ungated {metric.unit}".strip(), f"{metric.name}_gain", metric.digits, signed=True)
    return Column(metric.heading, metric.name, metric.digits), gain


RESULTS = (
    Column("T_post s", "t_post", 1),
    Column("saved %", "t_post_saved", 1),
    Column("s to ungated's PSNR", "time_to_ungated", 1, absent="not reached"),
    Column("T_total s", "t_total", 1),
    Column("saved %", "t_total_saved", 1),
    Column("iterations", "iterations_run", 0),
    Column("backwards %", "backwards_share", 1),
    *itertools.chain(*map(metric_columns, METRICS.values())),
    Column("peak GiB", "peak_memory_gib", 2),
)
TRAINING = tuple(Column(metric.heading, f"train_{metric.name}", metric.digits) for metric in METRICS.values())
SHARES = tuple(Column(phase, f"share_{phase}", 1) for phase in PHASES)
CLOCKS = {"wall": "", "processor": " for which its threads were running"}
TABLES = {
    "Time and quality, mean ± spread over seeds": RESULTS,
    "Quality on the training views, to see overfitting": TRAINING,
    "Share of refinement time, %": SHARES,
}


def tables(rows: Sequence[Row]) -> list[tuple[str, list[list[str]]]]:
    """Return (caption, lines) of every table that some row has values for."""
    found = [(caption, cells(rows, columns)) for caption, columns in TABLES.items()]
    return [(caption, lines) for caption, lines in found if len(lines[0]) > 2]


def cell(row: Row, column: Column) -> str:
    """Return "mean ± spread", "mean" with one seed, how many seeds have a value if not all, or the text without one."""
    value = row.values.get(column.name)
    if value is None:
        return column.absent if row.seeds else "-"
    text = f"{value.mean:{'+' if column.signed else ''}.{column.digits}f}"
    if value.spread is not None:
        text += f" ± {value.spread:.{column.digits}f}"
    return text if value.seeds is None else f"{text} ({value.seeds} of {len(row.seeds)})"


def cells(rows: Sequence[Row], columns: Sequence[Column]) -> list[list[str]]:
    """Return heading and rows as text: policy, number of seeds (marked when some are left out), values.

    A column that no row has a value for is left out.
    """
    columns = [column for column in columns if any(column.name in row.values for row in rows)]
    lines = [["policy", "seeds", *(column.heading for column in columns)]]
    for row in rows:
        total = len(row.seeds) + len(row.excluded)
        seeds = f"{len(row.seeds)} of {total} !" if row.excluded else str(total)
        lines.append([row.policy, seeds, *(cell(row, column) for column in columns)])
    return lines


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return heading and rows as a Markdown table, aligned to be read in a terminal too."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    rule = [("-" * width if i == 0 else "-" * (width - 1) + ":") for i, width in enumerate(widths)]
    text = []
    for line in [lines[0], rule, *lines[1:]]:
        padded = [c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))]
        text.append("| " + " | ".join(padded) + " |")
    return "\n".join(text)


def notes(rows: Sequence[Row], bench: dict[str, Any]) -> list[str]:
    """Return the sentences under the table: what was left out, what it could have been, how to read it."""
    sentences = [
        f"Seed {seed} of {row.policy} is left out of its means: {reason}."
        for row in rows
        for seed, reason in row.excluded.items()
    ]
    most = bench["ceiling"]
    if most is not None:
        sentences.append(
            f"A perfect gate at this skip rate could save {most['most']:.1f} % of refinement: backward and optimizer "
            f"take {most['share']:.1f} % of ungated time, and {most['skipped']:.1f} % of them are skipped. "
            f"Measured: {most['measured']:.1f} %."
        )
    for row in rows:
        if "wanted" in row.values:
            wanted, held_back = row.values["wanted"].mean, row.values["held_back"].mean
            sentences.append(
                f"After warm-up the rule of {row.policy} asked for a backward in {wanted:.1f} % of the iterations; in "
                f"{held_back:.1f} % its floor forbade a skip."
            )
    if bench["timing_noise"] is not None:
        sentences.append(
            "The forward pass is nearly the same work under every policy; within a seed its time per iteration "
            f"differed by up to {bench['timing_noise']:.0f} %. Differences in time below that are noise of the machine."
        )
    shown = [metric for metric in METRICS.values() if any(metric.name in row.values for row in rows)]
    scene, machine = bench["settings"]["scene"], bench["settings"]["machine"]
    first, last = bench["refinement"]
    sentences += [
        f"{scene['name']}, {', '.join(scene['image_sizes'])} pixels ({scene['images']}), {scene['train_views']} "
        f"training and {scene['test_views']} held-out views ({scene['split']}); iterations {first:,} to {last:,} "
        f"after one densification per seed, backend {machine['backend']} on {machine['gpu'] or machine['cpu']}, "
        f"{machine['threads']} threads.",
        "Mean ± sample standard deviation over seeds; saved % and vs ungated within each seed. T_post: seconds of "
        "refinement"
        + CLOCKS[bench["settings"].get("clock", "wall")]
        + ", T_total: densification too; evaluation and compilation are in neither. S to ungated's PSNR: of "
        "refinement until the final held-out PSNR of the same seed's ungated run, interpolated between evaluations. "
        "Backwards % of the iterations of the ungated run.",
        " ".join(f"{metric.label}: {metric.flavour}." for metric in shown)
        + ("" if any(metric.net for metric in shown) else " LPIPS is left out: no backbone weights on this machine."),
    ]
    if len(bench["commits"]) > 1:
        sentences.append(f"The runs were made at different commits: {', '.join(bench['commits'])}.")
    return sentences


def legend(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Return (policy, meaning) of every row."""
    unknown = "a policy of another version"
    return [(row.policy, POLICIES[row.policy].meaning if row.policy in POLICIES else unknown) for row in rows]
