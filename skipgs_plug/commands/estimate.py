"""`skipgs-plug estimate SCENE`: predict the time of a training run from its first half minute."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from skipgs_plug.commands.options.estimate import Args
from skipgs_plug.forecast.errors import measured_errors, spread
from skipgs_plug.forecast.pilot import Pilot, run_pilot
from skipgs_plug.forecast.predict import Forecast, predict
from skipgs_plug.trainer import load_scene
from skipgs_plug.trainer.ahead import prepare_kernels

HEADS = ("iterations", "time", "with --share auto", "Gaussians", "peak memory")
SHOWN = ("seconds", "seconds_auto", "gaussians", "memory")  # quantities of the table, in the order of HEADS


def run(args: Args) -> int:
    """Train for half a minute and print the table; see `Args`."""
    config = args.train
    prepare_kernels(config)
    scene = load_scene(args.scene, config.data_factor, config.test_every, config.init_num_pts, config.init_ply)
    pilot = run_pilot(config, scene, args.seconds, progress=not args.no_progress)
    print(described(scene.name, pilot))
    if not pilot.grew:
        # The first of so few iterations waits for kernels, so with it time would not be a lower bound.
        pilot = dataclasses.replace(pilot, samples=pilot.samples[1:])
    print(table([predict(pilot, config, steps) for steps in args.steps], "" if pilot.grew else "at least "))
    print(errors_seen() if pilot.grew else nothing_seen(args.seconds))
    return 0


def described(name: str, pilot: Pilot) -> str:
    """Return a line about the measured iterations."""
    seconds = sum(sample.seconds for sample in pilot.samples)
    return (
        f"{name}, {pilot.views} training views: {len(pilot.samples):,} iterations in {seconds:.0f} s, "
        f"{pilot.first_gaussians:,} to {pilot.samples[-1].gaussians:,} Gaussians.\n"
    )


def table(forecasts: Sequence[Forecast], bound: str = "") -> str:
    """Return one row per length of run, with `bound` before each value."""
    rows = [
        (
            f"{one.max_steps:,}",
            bound + duration(one.seconds),
            bound + duration(one.seconds_auto),
            bound + rounded(one.gaussians),
            "unknown" if one.memory is None else f"{bound}{one.memory / 2**30:.1f} GiB",
        )
        for one in forecasts
    ]
    widths = [max(map(len, column)) for column in zip(HEADS, *rows, strict=True)]
    lines = ["   ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in (HEADS, *rows)]
    return "\n".join(lines)


def nothing_seen(seconds: float) -> str:
    """Return the sentence for a pilot of some seconds in which no Gaussian was added."""
    return (
        "\nNo densification that adds Gaussians was seen. So their number is the present one: a lower bound, unless "
        "more are pruned than added. Time and memory depend on it, so they are lower bounds too; give a larger "
        f"--seconds than {seconds:g}."
    )


def errors_seen() -> str:
    """Return a sentence about the errors of earlier estimates, measured on runs of the bench."""
    rows = measured_errors()["rows"]
    scenes = sorted({row["scene"] for row in rows})
    seen = [100 * row["part"] for row in rows]
    parts = []
    for head, quantity in zip(HEADS[1:], SHOWN, strict=True):
        found = spread(rows, quantity)
        if found is None:
            parts.append(f"{head} not compared yet")
        else:
            low, high, count = found
            parts.append(f"{head} {100 * low:+.0f} to {100 * high:+.0f} % (runs: {count})")
    return (
        f"\nErrors of such estimates on {', '.join(scenes)}, made from {min(seen):.0f} to {max(seen):.0f} % of a "
        f"run: {'; '.join(parts)}. Loading and saving come on top."
    )


def duration(seconds: float) -> str:
    """Return a length of time with two significant digits.

    >>> duration(8.4), duration(95), duration(8000)
    ('8 s', '1.6 min', '2.2 h')
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.2g} min" if seconds < 3570 else f"{seconds / 3600:.2g} h"


def rounded(count: int) -> str:
    """Return a number with two significant digits.

    >>> rounded(118544), rounded(7)
    ('120,000', '7')
    """
    return f"{round(count, 2 - len(str(count))):,}"
