"""Draw the plots of runs from their folders, and of a bench from its decisions."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skipgs_plug.bench.plots import COLOURS, MARKERS, SMALL, label_of, new_figure, style
from skipgs_plug.bench.record import Trace
from skipgs_plug.trainer.pictures import jpeg_uri

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH = 5.2  # width of a plot in inches; text stays readable when a phone shrinks the plot to its screen
RUN_COLOUR = "#0072B2"
SKIP_COLOUR = "#D55E00"
ERROR_GAIN = 4  # factor on absolute errors in pictures: at 1, an error of 0.05 would look black
PARTS = 25  # parts of refinement in a plot of skips: enough for its shape, and each holds many iterations
REASON_COLOURS = {
    "warm-up": "#999999",
    "new view": "#56B4E9",
    "deviation": "#0072B2",
    "budget": "#009E73",
    "pause": "#F0E442",
    "non-finite": "#000000",
}


def skips_over_time(traces: Mapping[tuple[int, str], Trace]) -> Figure:
    """Plot the share of skipped backward passes in equal parts of refinement, as a mean over seeds, by policy."""
    figure, axes = new_figure(WIDTH, 3.4)
    for i, policy in enumerate(dict.fromkeys(policy for _, policy in traces)):
        colour, _ = style(policy)
        runs = [np.array(trace.skipped) for (_, name), trace in traces.items() if name == policy]
        if not any(run.any() for run in runs):
            continue
        start = next(trace.start for (_, name), trace in traces.items() if name == policy)
        edges = np.linspace(0, len(runs[0]), min(PARTS, len(runs[0])) + 1).round().astype(int)
        shares = [[100 * part.mean() for part in np.split(run, edges[1:-1])] for run in runs]
        width = max(1.0, 4.0 - 0.5 * i)  # if two policies agree, the wider line of the earlier one stays visible
        axes.stairs(np.mean(shares, axis=0), start + edges, baseline=None, color=colour, linewidth=width, label=policy)
    axes.set_ylim(-2, 102)
    axes.set_xlabel("iteration")
    axes.set_ylabel("backwards skipped (%)")
    figure.legend(frameon=False, fontsize=SMALL, ncols=2, loc="outside upper center")
    return figure


def loss_over_time(curves: Mapping[str, Mapping[str, list[float]]]) -> Figure:
    """Plot the training loss of each run over iterations. Each point is a mean over a part of the run."""
    figure, axes = new_figure(WIDTH, 3.4)
    for i, (name, curve) in enumerate(curves.items()):
        axes.plot(curve["step"], curve["loss"], color=COLOURS[i % len(COLOURS)], linewidth=1.2, label=label_of(name))
    axes.set_xlabel("iteration")
    axes.set_ylabel("training loss")
    if len(curves) > 1:
        figure.legend(frameon=False, fontsize=SMALL, ncols=2, loc="outside upper center")
    return figure


def gaussians_over_time(curves: Mapping[str, Mapping[str, list[float]]], ends: Mapping[str, float]) -> Figure:
    """Plot the number of Gaussians of each run over training time; `ends` holds the end of growing in seconds."""
    figure, axes = new_figure(WIDTH, 3.4)
    for i, (name, curve) in enumerate(curves.items()):
        colour = COLOURS[i % len(COLOURS)]
        axes.plot(curve["seconds"], curve["num_GS"], color=colour, linewidth=1.2, label=label_of(name))
        if name in ends:
            axes.axvline(ends[name], color=colour, linewidth=0.8, linestyle="--")
    axes.set_ylim(bottom=0)
    axes.set_xlabel("training (s)")
    axes.set_ylabel("Gaussians")
    axes.yaxis.set_major_formatter("{x:,.0f}")
    if len(curves) > 1:
        figure.legend(frameon=False, fontsize=SMALL, ncols=2, loc="outside upper center")
    return figure


def quality_of_views(runs: Mapping[str, list[dict[str, Any]]]) -> Figure:
    """Plot the PSNR of each evaluated view, sorted by name, with one marker style per run."""
    figure, axes = new_figure(WIDTH, 3.4)
    for i, (name, views) in enumerate(runs.items()):
        values = [row["psnr"] for row in views]
        colour, marker = COLOURS[i % len(COLOURS)], MARKERS[i % len(MARKERS)]
        axes.plot(
            range(len(views)), values, linestyle="none", marker=marker, markersize=5, color=colour, label=label_of(name)
        )
        axes.axhline(float(np.mean(values)), color=colour, linewidth=0.8, linestyle="--")
    axes.set_xlabel("view, by name")
    axes.set_ylabel("PSNR (dB)")
    axes.xaxis.get_major_locator().set_params(integer=True)
    if len(runs) > 1:
        figure.legend(frameon=False, fontsize=SMALL, ncols=2, loc="outside upper center")
    return figure


def view_shares(views: list[dict[str, Any]]) -> Figure:
    """Plot the share of skipped visits of each view, sorted by name."""
    figure, axes = new_figure(WIDTH, 3.0)
    share = [100 * row["skips"] / row["visits"] for row in views]
    axes.bar(range(len(views)), share, width=1.0 if len(views) > 60 else 0.8, color=SKIP_COLOUR)
    axes.set_ylim(0, 100)
    axes.set_xlim(-0.5, len(views) - 0.5)
    axes.set_xlabel("view, by name")
    axes.set_ylabel("visits skipped (%)")
    axes.grid(axis="x", visible=False)
    axes.xaxis.get_major_locator().set_params(integer=True)
    return figure


def loss_against_skips(views: list[dict[str, Any]]) -> Figure:
    """Plot the mean loss of each view against its share of skipped visits."""
    figure, axes = new_figure(WIDTH, 3.4)
    known = [row for row in views if row["mean_loss"] is not None]
    loss = np.array([row["mean_loss"] for row in known])
    share = np.array([100 * row["skips"] / row["visits"] for row in known])
    axes.plot(share, loss, linestyle="none", marker="o", markersize=4, color=RUN_COLOUR, alpha=0.7)
    axes.set_xlim(-3, 103)
    axes.set_xlabel("visits skipped (%)")
    axes.set_ylabel("running mean of loss")
    return figure


def reasons(data: dict[str, Any]) -> Figure:
    """Plot all gated iterations by reason, in one bar for backward passes that ran and one for skipped ones."""
    figure, axes = new_figure(WIDTH, 2.6)
    run = {k: v for k, v in data["reasons"].items() if k not in ("deviation", "non-finite")}
    lost = data["non_finite"]
    if data["settings"].get("on_nonfinite") == "pass":
        run["non-finite"], lost = lost, 0
    above = data["backwards_run"] - sum(run.values())
    parts = {
        "backward run": {**run, "deviation": above},
        "backward skipped": {"deviation": data["backwards_skipped"] - lost, "non-finite": lost},
    }
    names = {
        "deviation": {"backward run": "loss above its mean", "backward skipped": "loss at or below its mean"},
        "budget": {"backward run": "held back by the floor"},
    }
    for bar, counts in parts.items():
        left = 0
        for reason, count in counts.items():
            if count <= 0:
                continue
            colour = SKIP_COLOUR if bar == "backward skipped" else REASON_COLOURS.get(reason, "#CC79A7")
            label = names.get(reason, {}).get(bar, reason)
            axes.barh(bar, count, left=left, color=colour, height=0.65, label=f"{label} ({count:,})")
            left += count
    axes.invert_yaxis()
    axes.set_xlabel("iterations since the gate became active")
    axes.grid(axis="y", visible=False)
    axes.tick_params(left=False)
    figure.legend(frameon=False, fontsize=SMALL, ncols=2, loc="outside upper center")
    return figure


def inline_svg(figure: Figure) -> str:
    """Return a figure as the data URI of an SVG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode()


def inline_png(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode()


def split_render(path: Path) -> list[tuple[str, str]]:
    """Split a picture of photograph and render; return (data URI, title) of photograph, render and their error."""
    from PIL import Image

    with Image.open(path) as opened:
        both = np.asarray(opened.convert("RGB"))
    half = both.shape[1] // 2
    truth, render = both[:, :half], both[:, half : 2 * half]
    error = np.abs(truth.astype(np.int16) - render) * ERROR_GAIN
    pictures = {"Photograph": truth, "Render": render, f"Error x{ERROR_GAIN}": error.clip(0, 255).astype(np.uint8)}
    return [(jpeg_uri(picture), title) for title, picture in pictures.items()]
