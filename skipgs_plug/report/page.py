"""The page: a comparison when there are several runs, then one section for each run or bench."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any

from skipgs_plug.bench.store import flat
from skipgs_plug.bench.summary import row_from_dict
from skipgs_plug.bench.table import legend, notes, tables
from skipgs_plug.report import html, plots
from skipgs_plug.report.source import BenchSource, RunSource

RUN_HEADING = (
    "run",
    "iterations",
    "gated",
    "backwards run",
    "skipped",
    "skipped %",
    "floor",
    "paused",
    "non-finite",
    "T_post s",
    "T_total s",
)


def build_page(sources: Sequence[RunSource | BenchSource]) -> str:
    """Return one self-contained HTML page."""
    runs = [source for source in sources if isinstance(source, RunSource)]
    body = []
    if len(runs) > 1:
        body.append(run_table("All runs", runs))
    for source in sources:
        body += bench_section(source) if isinstance(source, BenchSource) else run_section(source)
    title = "SkipGS: " + ", ".join(source.name for source in sources)
    return html.document(title, "Which backward passes were left out, what that saved, and what it cost.", body)


def run_section(run: RunSource) -> list[str]:
    data = run.data
    parts = [f"<h2>{escape(run.name)}</h2>", run_table("What the gate did", [run])]
    if run.metrics:
        rows = [(name, rounded(value)) for name, value in run.metrics.items()]
        parts.append(html.table("Last evaluation", ("metric", "value"), rows, text=True))
    if data["gated_iterations"] == 0:
        parts.append(html.paragraphs(["The gate was never active in this run, so there is nothing to draw."]))
    else:
        parts.append(picture(plots.reasons(data), "Iterations since the gate became active, by what decided."))
        parts.append(picture(plots.view_shares(data["views"]), "Share of visits skipped, by training view."))
        if any(row["mean_loss"] is not None for row in data["views"]):
            parts.append(picture(plots.loss_against_skips(data["views"]), "One point per view: its loss and skips."))
    for path in run.renders:
        parts.append(html.picture(plots.inline_png(path), f"{path.name}: truth (left) and render (right).", width=720))
    if data["views"]:
        parts.append(html.details(f"Table of {len(data['views'])} views", view_table(data["views"])))
    parts.append(html.details("Settings", settings_table(data["settings"])))
    return parts


def bench_section(bench: BenchSource) -> list[str]:
    data = bench.data
    rows = [row_from_dict(row) for row in data["rows"]]
    parts = [
        f"<h2>Bench: {escape(data['settings']['scene']['name'])}</h2>",
        *(html.table(caption, lines[0], lines[1:]) for caption, lines in tables(rows)),
        html.paragraphs(notes(rows, data)),
    ]
    parts += [html.picture(plots.inline_png(path), text) for path, text in bench.pictures]
    if any(any(trace.skipped) for trace in bench.decisions.values()):
        text = "Share of backwards skipped in the course of refinement, one curve per policy that skips."
        parts.append(picture(plots.skips_over_time(bench.decisions), text))
    parts.append(html.table("Policies", ("policy", "meaning"), legend(rows), text=True))
    facts = {"command": data["command"], "commits": ", ".join(data["commits"]), **data["versions"]}
    parts.append(html.details("Command, machine, versions, settings", settings_table({**facts, **data["settings"]})))
    return parts


def run_table(caption: str, runs: Sequence[RunSource]) -> str:
    rows = []
    for run in runs:
        data, gated = run.data, run.data["gated_iterations"]
        share = f"{100 * data['backwards_skipped'] / gated:.1f}" if gated else "-"
        floor = data["min_bwd_ratio_effective"]
        rows.append(
            (
                run.name,
                *(f"{data[k]:,}" for k in ("iterations", "gated_iterations", "backwards_run", "backwards_skipped")),
                share,
                "-" if floor is None else f"{floor:.3f}",
                f"{data['paused']:,}",
                f"{data['non_finite']:,}",
                f"{data['t_post']:.1f}",
                f"{data['t_total']:.1f}",
            )
        )
    return html.table(caption, RUN_HEADING, rows)


def view_table(views: Sequence[dict[str, Any]]) -> str:
    names = ("view", "visits", "backwards", "skips", "mean_loss", "last_loss")
    return html.table("Views", names, [[rounded(row[name]) for name in names] for row in views])


def settings_table(settings: dict[str, Any]) -> str:
    rows = [(name, value) for name, value in flat(settings).items()]
    return html.table("Settings", ("name", "value"), rows, text=True)


def picture(figure: Any, alt: str) -> str:
    return html.picture(plots.inline_svg(figure), alt)


def rounded(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
