"""The one table, and the sentences that belong under it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from skipgs_plug.bench.policies import POLICIES
from skipgs_plug.bench.summary import Quantity, Row
from skipgs_plug.trainer.metrics import SSIM_FLAVOUR


@dataclass(frozen=True)
class Column:
    """A column: heading, name in `Row.values`, digits after the point, sign shown or not."""

    heading: str
    name: str
    digits: int
    signed: bool = False


RESULTS = (
    Column("T_post s", "t_post", 1),
    Column("saved %", "t_post_saved", 1),
    Column("T_total s", "t_total", 1),
    Column("saved %", "t_total_saved", 1),
    Column("iterations", "iterations", 0),
    Column("backwards %", "backwards_share", 1),
    Column("PSNR dB", "psnr", 2),
    Column("vs ungated dB", "psnr_gain", 2, signed=True),
    Column("SSIM", "ssim", 4),
    Column("LPIPS alex", "lpips_alex", 4),
    Column("LPIPS vgg", "lpips_vgg", 4),
    Column("peak GiB", "peak_memory_gib", 2),
)
SHARES = (
    Column("forward", "share_forward", 1),
    Column("loss", "share_loss", 1),
    Column("backward", "share_backward", 1),
    Column("optimizer", "share_optimizer", 1),
)


def cell(value: Quantity | None, column: Column) -> str:
    """Return "mean ± spread", "mean" with one seed, or a dash."""
    if value is None:
        return "-"
    mean = f"{value.mean:{'+' if column.signed else ''}.{column.digits}f}"
    return mean if value.spread is None else f"{mean} ± {value.spread:.{column.digits}f}"


def cells(rows: Sequence[Row], columns: Sequence[Column]) -> list[list[str]]:
    """Return heading and rows as text: policy, number of seeds (marked when some are left out), values.

    A column that no row has a value for is left out.
    """
    columns = [column for column in columns if any(column.name in row.values for row in rows)]
    lines = [["policy", "seeds", *(column.heading for column in columns)]]
    for row in rows:
        total = len(row.seeds) + len(row.excluded)
        seeds = f"{len(row.seeds)} of {total} !" if row.excluded else str(total)
        lines.append([row.policy, seeds, *(cell(row.values.get(column.name), column) for column in columns)])
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
    scene, machine = bench["settings"]["scene"], bench["settings"]["machine"]
    first, last = bench["refinement"]
    sentences += [
        f"{scene['name']}, {', '.join(scene['image_sizes'])} pixels ({scene['images']}), {scene['train_views']} "
        f"training and {scene['test_views']} held-out views ({scene['split']}); iterations {first:,} to {last:,} "
        f"after one densification per seed, backend {machine['backend']} on {machine['gpu'] or machine['cpu']}, "
        f"{machine['threads']} threads.",
        "Mean ± sample standard deviation over seeds; saved % and vs ungated within each seed. T_post: seconds of "
        "refinement, T_total: densification too; evaluation and compilation are in neither. Backwards % of the "
        "ungated number. PSNR: mean of per-image values, float render.",
        f"SSIM: {SSIM_FLAVOUR}. "
        + (
            f"LPIPS: {bench['settings']['lpips']}, inputs normalised."
            if bench["settings"]["lpips"]
            else "LPIPS is left out: no backbone weights on this machine."
        ),
    ]
    if len(bench["commits"]) > 1:
        sentences.append(f"The runs were made at different commits: {', '.join(bench['commits'])}.")
    return sentences


def legend(rows: Sequence[Row]) -> list[tuple[str, str]]:
    """Return (policy, meaning) of every row."""
    return [(row.policy, POLICIES[row.policy].meaning) for row in rows]
