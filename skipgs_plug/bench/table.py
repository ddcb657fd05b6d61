"""The tables of a bench, and the sentences under them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug.bench.find import find_policy
from skipgs_plug.bench.refine import MOST_DB
from skipgs_plug.bench.summary import Row
from skipgs_plug.trainer.clock import PHASES
from skipgs_plug.trainer.metrics import METRICS, Metric


@dataclass(frozen=True)
class Column:
    """A column of a table.

    Attributes:
        heading: Text above the column.
        name: Key in `Row.values`.
        digits: Number of digits after the decimal point.
        signed: Whether positive values have a sign.
        absent: Text of a cell without a value.
    """

    heading: str
    name: str
    digits: int
    signed: bool = False
    absent: str = "-"


def metric_columns(metric: Metric) -> tuple[Column, Column]:
    """Return the columns of a metric on held-out views, and of its difference from the own run."""
    gain = Column(f"vs own {metric.unit}".strip(), f"{metric.name}_gain", metric.digits, signed=True)
    return Column(metric.heading, metric.name, metric.digits), gain


REFINEMENT = (
    Column("T_post s", "t_post", 1),
    Column("saved %", "t_post_saved", 1),
    Column("s to own PSNR", "time_to_own", 1, absent="not reached"),
    Column("T_total s", "t_total", 1),
    Column("saved %", "t_total_saved", 1),
    Column("iterations", "iterations_run", 0),
    Column("backwards %", "backwards_share", 1),
    *itertools.chain(*map(metric_columns, METRICS.values())),
    Column("peak GiB", "peak_memory_gib", 2),
)
WHOLE = (
    Column("T_total s", "t_total", 1),
    Column("% of own", "t_total_share", 1),
    Column("wall-clock s", "t_total_wall", 1),
    Column("s to own PSNR", "time_to_own", 1, absent="not reached"),
    Column("T_post s", "t_post", 1),
    Column("iterations", "iterations_run", 0),
    Column("Gaussians", "num_GS", 0),
    Column("% of own", "num_GS_share", 1),
    *itertools.chain(*map(metric_columns, METRICS.values())),
    Column("peak GiB", "peak_memory_gib", 2),
)
TRAINING = tuple(Column(metric.heading, f"train_{metric.name}", metric.digits) for metric in METRICS.values())
SHARES = tuple(Column(phase, f"share_{phase}", 1) for phase in PHASES)
CLOCKS = {"wall": "wall-clock seconds", "processor": "processor seconds, summed over threads,"}
REFINEMENT_READING = (
    "Values are mean ± sample standard deviation over seeds. Saved % and vs own compare runs of the same seed. "
    "T_post: {clock} of refinement. T_total: the same, with densification. Both exclude evaluation and "
    "compilation. S to own PSNR: seconds of refinement until a run reaches the final held-out PSNR of the own run of "
    "the same seed, interpolated between evaluations. Backwards %: backward passes in percent of the iterations of the "
    "own run."
)
WHOLE_READING = (
    "Values are mean ± sample standard deviation over seeds. % of own and vs own compare runs of the same seed. "
    "T_total: {clock} of the whole run. T_post: {clock} of its refinement. Both exclude evaluation and "
    "compilation. S to own PSNR: seconds of the whole run until it reaches the final held-out PSNR of the own run of "
    "the same seed, interpolated between evaluations. More Gaussians make better images and need more memory: compare "
    "image quality at equal numbers of Gaussians. Peak GiB: largest memory in use, on a GPU without the memory that "
    "other runs held, on the CPU that of the whole process."
)


def tables(rows: Sequence[Row], whole: bool = False) -> list[tuple[str, list[list[str]]]]:
    """Return (caption, lines) of every table with at least one value, for whole runs or for refinements."""
    contents = {
        "Time and quality, mean ± spread over seeds": WHOLE if whole else REFINEMENT,
        "Quality on the training views, to see overfitting": TRAINING,
        "Share of time, %" if whole else "Share of refinement time, %": SHARES,
    }
    found = [(caption, cells(rows, columns)) for caption, columns in contents.items()]
    return [(caption, lines) for caption, lines in found if len(lines[0]) > 2]


def cell(row: Row, column: Column) -> str:
    """Return the text of a cell: "mean ± spread", or "mean" with one seed, or `Column.absent` without a value.

    If some seeds have no value, the number of seeds with a value follows.
    """
    value = row.values.get(column.name)
    if value is None:
        return column.absent if row.seeds else "-"
    text = f"{value.mean:{'+' if column.signed else ''}.{column.digits}f}"
    if value.spread is not None:
        text += f" ± {value.spread:.{column.digits}f}"
    return text if value.seeds is None else f"{text} ({value.seeds} of {len(row.seeds)})"


def cells(rows: Sequence[Row], columns: Sequence[Column]) -> list[list[str]]:
    """Return heading and rows as text: policy, number of seeds (marked if some are left out), and values.

    A column without any value is left out.
    """
    columns = [column for column in columns if any(column.name in row.values for row in rows)]
    lines = [["policy", "seeds", *(column.heading for column in columns)]]
    for row in rows:
        total = len(row.seeds) + len(row.excluded)
        seeds = f"{len(row.seeds)} of {total} !" if row.excluded else str(total)
        lines.append([row.policy, seeds, *(cell(row, column) for column in columns)])
    return lines


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """Return heading and rows as a Markdown table, aligned for terminals."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    rule = [("-" * width if i == 0 else "-" * (width - 1) + ":") for i, width in enumerate(widths)]
    text = []
    for line in [lines[0], rule, *lines[1:]]:
        padded = [c.ljust(w) if i == 0 else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))]
        text.append("| " + " | ".join(padded) + " |")
    return "\n".join(text)


def notes(rows: Sequence[Row], bench: dict[str, Any]) -> list[str]:
    """Return the sentences under the table: values left out, bounds, and how to read the table."""
    sentences = [
        f"Seed {seed} of {row.policy} is left out of its means: {reason}."
        for row in rows
        for seed, reason in row.excluded.items()
    ]
    most = bench["ceiling"]
    if most is not None:
        sentences.append(
            f"A perfect gate at this skip rate could save {most['most']:.1f} % of refinement: backward and optimizer "
            f"take {most['share']:.1f} % of the own run's time, and {most['skipped']:.1f} % of them are skipped. "
            f"Measured: {most['measured']:.1f} %."
        )
    for row in rows:
        if "wanted" in row.values:
            wanted, held_back = row.values["wanted"].mean, row.values["held_back"].mean
            sentences.append(
                f"After warm-up, the rule of {row.policy} asked for a backward pass in {wanted:.1f} % of the "
                f"iterations; in {held_back:.1f} % its floor forbade a skip."
            )
    if bench["timing_noise"] is not None:
        sentences.append(
            "The forward pass does nearly the same work under every policy. Within a seed, its time per iteration "
            f"differed by up to {bench['timing_noise']:.0f} %; smaller differences in time are noise of the machine."
        )
    for run in bench["runs"]:
        if run.get("exact_views"):
            sentences.append(
                f"Seed {run['seed']} of {run['policy']} renders {run['exact_views']} held-out views without any error, "
                f"for example views of background only. Their PSNR is infinite and counts as {MOST_DB:.0f} dB."
            )
        sentences += [searched(run)] if run.get("tries") else []
    shown = [metric for metric in METRICS.values() if any(metric.name in row.values for row in rows)]
    scene, machine = bench["settings"]["scene"], bench["settings"]["machine"]
    first, last = bench["refinement"]
    whole = is_whole(bench)
    span = (
        f"whole runs of {last:,} iterations, densification to {first:,}"
        if whole
        else f"iterations {first:,} to {last:,} after one densification per seed"
    )
    clock = CLOCKS[bench["settings"].get("clock", "wall")]
    sentences += [
        f"{scene['name']}, {', '.join(scene['image_sizes'])} pixels ({scene['images']}), {scene['train_views']} "
        f"training and {scene['test_views']} held-out views ({scene['split']}); {span}, backend {machine['backend']} "
        f"on {machine['gpu'] or machine['cpu']}, {machine['threads']} threads.",
        WHOLE_READING.format(clock=clock) if whole else REFINEMENT_READING.format(clock=clock),
        " ".join(f"{metric.label}: {metric.flavour}." for metric in shown)
        + ("" if any(metric.net for metric in shown) else " LPIPS is left out: no backbone weights on this machine."),
    ]
    if len(bench["commits"]) > 1:
        sentences.append(f"The runs were made at different commits: {', '.join(bench['commits'])}.")
    return sentences


def searched(run: dict[str, Any]) -> str:
    """Return a sentence that lists the tries of a search."""
    tries = "; ".join(", ".join(f"{name} {value:.6g}" for name, value in one.items()) for one in run["tries"])
    return f"Seed {run['seed']} of {run['policy']} was found by these tries: {tries}."


def is_whole(bench: dict[str, Any]) -> bool:
    """Whether a bench compares whole runs."""
    return bool(bench["settings"].get("whole", False))


def legend(rows: Sequence[Row], whole: bool = False) -> list[tuple[str, str]]:
    """Return the policy of every row and its meaning, for whole runs or for refinements."""
    found = [(row.policy, find_policy(row.policy, whole)) for row in rows]
    return [(name, "a policy of another version" if spec is None else spec.meaning) for name, spec in found]
