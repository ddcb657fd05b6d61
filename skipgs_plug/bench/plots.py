"""The plots of a bench, written as PNG, in colours that colour-blind readers can distinguish (Okabe-Ito)."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from skipgs_plug.bench.find import known_policies
from skipgs_plug.bench.record import RunRecord, Trace
from skipgs_plug.bench.summary import HEADLINE, Quantity, Row
from skipgs_plug.trainer.files import write_aside

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#000000", "#D55E00", "#E69F00", "#CC79A7", "#0072B2", "#56B4E9", "#009E73")
MARKERS = "so^vDPX"
PHASES = {"forward": "#0072B2", "loss": "#56B4E9", "backward": "#D55E00", "optimizer": "#E69F00", "strategy": "#009E73"}
NOT_VISITED, RUN, SKIPPED = 0, 1, 2  # values of `visit_map`, and indices of colours
EXAMPLES = 3  # number of views with a plot of their own; three plots fit on one page
SMALL = 9  # font size of legends in points, small enough for eleven policies


def write_plots(
    folder: Path, records: Sequence[RunRecord], rows: Sequence[Row], view_names: Sequence[str], whole: bool = False
) -> None:
    """Write every plot for which the finished runs have data, for whole runs or for refinements."""
    done = [record for record in records if record.status == "done"]
    if not done:
        return
    save(folder / "psnr_over_time.png", psnr_over_time(done, rows, whole))
    save(folder / "time_against_error.png", time_against_error(rows, whole))
    save(folder / "phases.png", phases(rows, whole))
    if whole:
        return
    skipping = [record for record in done if record.skips]
    gated = next((record for record in skipping if looks_at_losses(record)), None)
    if gated is not None:
        control = (r for r in skipping if r.seed == gated.seed and not looks_at_losses(r))
        save(folder / "skipped_views.png", skipped_views([gated, *itertools.islice(control, 1)], len(view_names)))
        save(folder / "loss_and_mean.png", loss_and_mean(gated, view_names))


def style(policy: str, whole: bool = False) -> tuple[str, str]:
    """Return colour and marker of a policy by its place in the table.

    An unknown policy gets a place that depends on its name only.
    """
    known = list(known_policies(whole))
    index = known.index(policy) if policy in known else zlib.crc32(policy.encode()) % len(COLOURS) - len(COLOURS)
    # Each round through the colours shifts the markers by one, so that all pairs differ.
    return COLOURS[index % len(COLOURS)], MARKERS[(index + index // len(COLOURS)) % len(MARKERS)]


def looks_at_losses(run: RunRecord) -> bool:
    """Whether the policy of this run keeps means of losses."""
    return run.trace is not None and any(mean is not None for mean in run.trace.mean)


def psnr_over_time(records: Sequence[RunRecord], rows: Sequence[Row], whole: bool) -> Figure:
    """Plot the mean held-out PSNR over seeds against seconds of the whole run or of refinement, a curve per policy."""
    figure, axes = new_figure(9.0, 4.6)
    for row in rows:
        runs = [r for r in records if r.policy == row.policy]
        if not runs:
            continue
        seconds = np.mean([[point.seconds for point in run.points] for run in runs], axis=0)
        psnr = np.mean([[point.metrics[HEADLINE] for point in run.points] for run in runs], axis=0)
        colour, marker = style(row.policy, whole)
        axes.plot(seconds, psnr, color=colour, marker=marker, markersize=5, linewidth=1.6, label=row.policy)
    axes.set_xlabel("training time, T_total (s)" if whole else "training time since the end of densification (s)")
    axes.set_ylabel("held-out PSNR (dB)")
    figure.legend(frameon=False, fontsize=SMALL, loc="outside right center")
    axes.set_title(f"Quality against time, {seeds_text(rows)}", loc="left", fontsize=11)
    return figure


def time_against_error(rows: Sequence[Row], whole: bool) -> Figure:
    """Plot final PSNR against time, absolute and relative to the own run of the same seed.

    Time is that of the whole run, or that of refinement.
    """
    name, label = ("t_total", "time of the whole run T_total") if whole else ("t_post", "refinement time T_post")
    paired = any("psnr_gain" in row.values for row in rows)
    figure, *axes = new_figure(9.6 if paired else 6.0, 4.4, columns=2 if paired else 1)
    scatter(axes[0], rows, name, "psnr", whole)
    axes[0].set_xlabel(f"{label} (s)")
    axes[0].set_ylabel("held-out PSNR (dB)")
    axes[0].set_title(f"Time and quality, {seeds_text(rows)}", loc="left", fontsize=11)
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, fontsize=SMALL, ncols=5 if paired else 3,
                  loc="outside lower center")  # fmt: skip
    if paired:
        scatter(axes[1], rows, f"{name}_saved", "psnr_gain", whole)
        axes[1].axhline(0, color="0.7", linewidth=0.8, zorder=0)
        axes[1].axvline(0, color="0.7", linewidth=0.8, zorder=0)
        axes[1].set_xlabel(f"{name.capitalize()} saved (%)")
        axes[1].set_ylabel("PSNR above the own run (dB)")
        axes[1].set_title("Against the own run of the same seed", loc="left", fontsize=11)
    return figure


def scatter(axes: Axes, rows: Sequence[Row], x_name: str, y_name: str, whole: bool) -> None:
    for row in rows:
        x, y = row.values.get(x_name), row.values.get(y_name)
        if x is None or y is None:
            continue
        colour, marker = style(row.policy, whole)
        axes.errorbar(
            x.mean, y.mean, xerr=bar(x), yerr=bar(y), color=colour, marker=marker, markersize=8, linestyle="none",
            linewidth=1.2, capsize=3, label=row.policy,
        )  # fmt: skip
    axes.margins(0.12)


def bar(quantity: Quantity) -> float:
    return quantity.spread or 0.0


def phases(rows: Sequence[Row], whole: bool) -> Figure:
    """Plot the seconds of each phase of the whole run or of refinement, one bar per policy."""
    time = "t_total" if whole else "t_post"
    rows = [row for row in rows if row.seeds]
    figure, axes = new_figure(7.6, 0.9 + 0.45 * len(rows))
    left = np.zeros(len(rows))
    names = [row.policy for row in rows]
    for phase, colour in PHASES.items():
        if any(f"share_{phase}" not in row.values for row in rows):
            continue  # refinement has no densification
        width = np.array([r.values[f"share_{phase}"].mean * r.values[time].mean / 100 for r in rows])
        axes.barh(names, width, left=left, color=colour, label=phase, height=0.7)
        left += width
    axes.invert_yaxis()
    axes.set_xlabel("training time (s)" if whole else "refinement time (s)")
    axes.tick_params(left=False)
    axes.grid(axis="y", visible=False)
    figure.legend(frameon=False, fontsize=SMALL, ncols=4, loc="outside upper center")
    return figure


def skipped_views(runs: Sequence[RunRecord], n_views: int) -> Figure:
    """Plot for every view which visits were skipped over time, one panel per policy."""
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ["#FFFFFF", "#DCE6EE", "#D55E00"]
    figure, *axes = new_figure(9.6, 4.4, columns=len(runs), sharey=True)
    for panel, run in zip(axes, runs, strict=True):
        assert run.trace is not None
        visits = visit_map(run.trace, n_views)
        left = run.trace.start // n_views * n_views
        panel.imshow(
            visits, aspect="auto", interpolation="nearest", cmap=ListedColormap(colours), vmin=NOT_VISITED,
            vmax=SKIPPED, extent=(left, left + visits.shape[1] * n_views, n_views - 0.5, -0.5),
        )  # fmt: skip
        panel.yaxis.get_major_locator().set_params(integer=True)
        if run.warm_up:
            panel.axvline(run.trace.start + run.warm_up, color="0.25", linewidth=1, linestyle=(0, (4, 3)))
        percent = 100 * run.skips / run.iterations_run
        panel.set_title(f"{run.policy}, seed {run.seed}: {percent:.0f} % skipped", loc="left", fontsize=11)
        panel.set_xlabel("iteration (dashed: end of warm-up)")
        panel.grid(visible=False)
    axes[0].set_ylabel("training view")
    handles = [Patch(color=colours[RUN], label="backward run"), Patch(color=colours[SKIPPED], label="backward skipped")]
    figure.legend(handles=handles, frameon=False, fontsize=SMALL, ncols=2, loc="outside upper right")
    return figure


def visit_map(trace: Trace, n_views: int) -> np.ndarray:
    """Return an array [n_views, epochs] of NOT_VISITED, RUN or SKIPPED.

    Training visits every view once in an epoch. Refinement may begin and end in the middle of an epoch.
    """
    first = trace.start // n_views
    last = (trace.start + len(trace.view) - 1) // n_views
    grid = np.full((n_views, last - first + 1), NOT_VISITED)
    for i, (view, skipped) in enumerate(zip(trace.view, trace.skipped, strict=True)):
        if view is not None:
            grid[view, (trace.start + i) // n_views - first] = SKIPPED if skipped else RUN
    return grid


def loss_and_mean(run: RunRecord, view_names: Sequence[str]) -> Figure:
    """Plot the loss of three views and its running mean: the most skipped view, one in the middle, and the least."""
    trace = run.trace
    assert trace is not None
    by_view: dict[int, list[int]] = {}
    for i, view in enumerate(trace.view):
        if view is not None:
            by_view.setdefault(view, []).append(i)
    skipped = trace.skipped
    ranked = sorted(by_view, key=lambda view: (-sum(skipped[i] for i in by_view[view]) / len(by_view[view]), view))
    picked = sorted({0, len(ranked) // 2, len(ranked) - 1})[:EXAMPLES]
    figure, *panels = new_figure(7.6, 1.2 + 1.75 * len(picked), rows=len(picked), sharex=True)
    for panel, rank in zip(panels, picked, strict=True):
        view, visits = ranked[rank], np.array(by_view[ranked[rank]])
        steps = trace.start + visits
        loss = np.array([trace.loss[i] for i in visits])
        mean = np.array([np.nan if trace.mean[i] is None else trace.mean[i] for i in visits], dtype=float)
        out = np.array([skipped[i] for i in visits])
        panel.plot(steps, mean, color="0.35", linewidth=1.4, label="running mean")
        panel.plot(steps[~out], loss[~out], linestyle="none", marker="o", markersize=3.6, color="#0072B2",
                   label="loss, backward run")  # fmt: skip
        panel.plot(steps[out], loss[out], linestyle="none", marker="o", markersize=3.6, color="#D55E00",
                   markerfacecolor="white", label="loss, backward skipped")  # fmt: skip
        count = f"{out.sum()} of {len(out)} visits skipped"
        panel.set_title(f"{label_of(view_names[view])}: {count}", loc="left", fontsize=SMALL + 1)
        panel.set_ylabel("loss")
    panels[-1].set_xlabel("iteration")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=SMALL, ncols=3, loc="outside upper center")
    return figure


def seeds_text(rows: Sequence[Row]) -> str:
    seeds = {seed for row in rows for seed in row.seeds}
    return "one seed" if len(seeds) == 1 else f"mean of {len(seeds)} seeds"


def label_of(name: str) -> str:
    """Return the name of a file or folder as matplotlib's text.

    Characters that its font lacks become escapes, `$` begins no formula, and a legend shows a name that begins with _.
    """
    from matplotlib.font_manager import FontProperties, findfont, get_font

    known = get_font(findfont(FontProperties())).get_charmap()
    shown = "".join(c if ord(c) in known else c.encode("ascii", "backslashreplace").decode() for c in name)
    return shown.replace("$", r"\$").replace("_", " _", shown.startswith("_"))


def new_figure(width: float, height: float, rows: int = 1, columns: int = 1, **shared: Any) -> Any:
    """Return a figure and its axes, without frame clutter."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, **shared).ravel()
    for axes in grid:
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(color="0.92", linewidth=0.8)
        axes.set_axisbelow(True)
    return figure, *grid


def save(path: Path, figure: Figure) -> None:
    with write_aside(path) as temporary:
        figure.savefig(temporary, format="png", dpi=120)
