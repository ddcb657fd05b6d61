"""Build the page: a comparison if there are several runs, then one section for each run or bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skipgs_plug.bench.store import flat
from skipgs_plug.bench.summary import row_from_dict
from skipgs_plug.bench.table import is_whole, legend, notes, tables
from skipgs_plug.report import plots
from skipgs_plug.report.elements import Details, Element, Picture, Section, Strip, Table, Text, write_page
from skipgs_plug.report.phases import phase_elements
from skipgs_plug.report.source import SPLITS, BenchSource, RunSource

GATE_HEADING = (
    "run",
    "iterations",
    "gated",
    "backwards run",
    "skipped",
    "skipped %",
    "floor",
    "paused",
    "non-finite",
)
REFINEMENT_HEADING = (
    "run",
    "iterations allowed, %",
    "iterations run",
    "left out",
    "always run",
    "ended early",
    "remaining gain, upper bound, dB",
)
PSNR = {split: f"{split} PSNR, dB" for split in SPLITS.values()}
FITTED = "PSNR, colours fitted, dB"
RARE = (PSNR["training"], FITTED)  # rows that only runs without held-out views have, or with --exposure
RESULTS = (
    *PSNR.values(),
    FITTED,
    "worst view, dB",
    "SSIM",
    "Gaussians",
    "training, s",
    "after densification, s",
    "backwards skipped, %",
)
FOLDERS = ("data_dir", "result_dir")  # settings that do not change the model
PICTURED = 3  # number of evaluated views of each run that the page shows, the worst ones


def build_page(sources: Sequence[RunSource | BenchSource]) -> str:
    """Return one self-contained HTML page."""
    runs = [source for source in sources if isinstance(source, RunSource)]
    sections = [comparison(runs)] if len(runs) > 1 else []
    for source in sources:
        sections.append(bench_section(source) if isinstance(source, BenchSource) else run_section(source))
    title = "SkipGS: " + ", ".join(source.name for source in sources)
    return write_page(title, "Quality of the trained models, left-out work, and time saved.", sections)


def comparison(runs: Sequence[RunSource]) -> Section:
    """Return the section that shows several runs side by side."""
    names = unique_names(runs)
    elements: list[Element] = [results("All runs", runs), *different_settings(names)]
    curves = {name: run.curve for name, run in names.items() if run.curve}
    if curves:
        elements.append(picture(plots.loss_over_time(curves), "Training loss over iterations."))
        elements.append(picture(plots.gaussians_over_time(curves, {}), "Number of Gaussians over training time."))
    views = {name: run.views for name, run in names.items() if run.views and run.split == SPLITS["val"]}
    if views:
        elements.append(picture(plots.quality_of_views(views), "PSNR of each held-out view; dashed: mean of each run."))
    return Section("Side by side", elements)


def different_settings(runs: Mapping[str, RunSource]) -> list[Element]:
    """Return a table of the training settings that differ, such as the size of the images; nothing if all are equal."""
    settings = [dict(flat(run.settings)) for run in runs.values()]
    known = [one for one in settings if one]
    rows = [
        [name, *(rounded(one.get(name)) for one in settings)]
        for name in (known[0] if known else ())
        if name not in FOLDERS and all(name in one for one in known) and len({str(one[name]) for one in known}) > 1
    ]
    return [Table("Settings that differ", ("", *runs), rows)] if rows else []


def unique_names(runs: Sequence[RunSource]) -> dict[str, RunSource]:
    """Return the runs by name, or by path if several runs share a name."""
    names = [run.name for run in runs]
    return {run.name if names.count(run.name) == 1 else str(run.path): run for run in runs}


def run_section(run: RunSource) -> Section:
    elements: list[Element] = [results("Results", [run])]
    # Older versions, which could not leave out iterations, did not write this field.
    if run.gate is not None and run.gate.get("refine_share") is not None:
        elements += phase_elements(run.gate, run.curve)
    if run.curve:
        elements.append(picture(plots.loss_over_time({run.name: run.curve}), "Training loss over iterations."))
        elements.append(gaussians(run))
    if run.views:
        caption = f"PSNR of {run.split} views; dashed: mean."
        elements.append(picture(plots.quality_of_views({run.name: run.views}), caption))
    elements += pictured_views(run)
    if run.gate is not None:
        elements += gate_elements(run.name, run.gate)
    if run.views:
        names = list(run.views[0])
        rows = [[rounded(row[name]) for name in names] for row in run.views]
        table = Table("Evaluated views", names, rows)
        elements.append(Details(f"Table of {len(rows)} evaluated views, {run.split}", [table]))
    if run.metrics:
        metrics = [(name, rounded(value)) for name, value in run.metrics.items()]
        elements.append(Details("Last evaluation", [Table("Last evaluation", ("metric", "value"), metrics, text=True)]))
    if run.settings:
        elements.append(Details("Settings of training", [settings_table("Settings of training", run.settings)]))
    return Section(run.name, elements)


def gaussians(run: RunSource) -> Picture:
    """Plot the number of Gaussians during training, and the end of densification if it is known."""
    caption = "Number of Gaussians over training time."
    ends = {}
    if run.t_total is not None and run.t_post:
        ends[run.name] = run.t_total - run.t_post
        caption = "Number of Gaussians over training time; dashed: the end of growing."
    return picture(plots.gaussians_over_time({run.name: run.curve}, ends), caption)


def pictured_views(run: RunSource) -> list[Element]:
    """Return pictures of the worst evaluated views, or of the first ones if their quality is unknown."""
    if len(run.views) != len(run.renders):
        return [Strip(path.name, plots.split_render(path)) for path in run.renders[:PICTURED]]
    worst = sorted(zip(run.views, run.renders, strict=True), key=lambda pair: pair[0]["psnr"])[:PICTURED]
    return [
        Strip(
            f"{row['view']}: {row['psnr']:.2f} dB, {place} of {len(run.views)} {run.split} views.",
            plots.split_render(path),
        )
        for place, (row, path) in zip(("worst", "second worst", "third worst"), worst, strict=False)
    ]


def gate_elements(name: str, data: dict[str, Any]) -> list[Element]:
    elements: list[Element] = [gate_table("Decisions of the gate", name, data)]
    if data.get("refine_share") is not None:  # older versions did not write this field
        elements.append(refinement_table("Whole iterations left out", name, data))
    views = data["views"]
    if data["gated_iterations"] == 0:
        elements.append(Text(["The gate was never active in this run, so there is nothing to draw."]))
    else:
        elements.append(picture(plots.reasons(data), "Iterations since the gate became active, by reason of decision."))
        elements.append(picture(plots.view_shares(views), "Share of skipped visits of each training view."))
        if any(row["mean_loss"] is not None for row in views):
            elements.append(picture(plots.loss_against_skips(views), "Loss and skipped visits, one point per view."))
    if views:
        names = ("view", "visits", "backwards", "skips", "mean_loss", "last_loss")
        rows = [[rounded(row[name]) for name in names] for row in views]
        elements.append(Details(f"Table of {len(views)} training views", [Table("Training views", names, rows)]))
    elements.append(Details("Settings of the gate", [settings_table("Settings of the gate", data["settings"])]))
    return elements


def bench_section(bench: BenchSource) -> Section:
    data = bench.data
    rows = [row_from_dict(row) for row in data["rows"]]
    elements: list[Element] = [Table(caption, lines[0], lines[1:]) for caption, lines in tables(rows, is_whole(data))]
    elements.append(Text(notes(rows, data)))
    elements += [Picture(plots.inline_png(path), text, wide=True) for path, text in bench.pictures]
    if any(any(trace.skipped) for trace in bench.decisions.values()):
        text = "Share of backward passes skipped during refinement, one curve per policy that skips."
        elements.append(picture(plots.skips_over_time(bench.decisions), text))
    elements.append(Table("Policies", ("policy", "meaning"), legend(rows, is_whole(data)), text=True))
    facts = {"command": data["command"], "commits": ", ".join(data["commits"]), **data["versions"], **data["settings"]}
    elements.append(Details("Command, machine, versions, settings", [settings_table("Settings", facts)]))
    return Section(f"Bench: {data['settings']['scene']['name']}", elements)


def results(caption: str, runs: Sequence[RunSource]) -> Table:
    """Return quality and time, one column per run, with a dash for each value that a folder lacks."""
    columns = []
    for run in runs:
        worst = min((row["psnr"] for row in run.views), default=None)
        skipped = None
        if run.gate is not None and run.gate["gated_iterations"]:
            skipped = 100 * run.gate["backwards_skipped"] / run.gate["gated_iterations"]
        values = (
            *((run.metrics.get("psnr") if run.split == split else None, ".2f") for split in PSNR),
            (run.metrics.get("cc_psnr"), ".2f"),
            (worst, ".2f"),
            (run.metrics.get("ssim"), ".4f"),
            (run.metrics.get("num_GS"), ","),
            (run.t_total, ".1f"),
            (run.t_post, ".1f"),
            (skipped, ".1f"),
        )
        columns.append(["-" if value is None else format(value, form) for value, form in values])
    rows = [[name, *cells] for name, *cells in zip(RESULTS, *columns, strict=True)]
    rows = [row for row in rows if row[0] not in RARE or set(row[1:]) != {"-"}]
    return Table(caption, ("", *unique_names(runs)), rows)


def gate_table(caption: str, name: str, data: dict[str, Any]) -> Table:
    gated = data["gated_iterations"]
    floor = data["min_bwd_ratio_effective"]
    row = (
        name,
        *(f"{data[k]:,}" for k in ("iterations", "gated_iterations", "backwards_run", "backwards_skipped")),
        f"{100 * data['backwards_skipped'] / gated:.1f}" if gated else "-",
        "-" if floor is None else f"{floor:.3f}",
        f"{data['paused']:,}",
        f"{data['non_finite']:,}",
    )
    return Table(caption, GATE_HEADING, [row])


def refinement_table(caption: str, name: str, data: dict[str, Any]) -> Table:
    early_stopping = data["early_stopping"] or {}
    worth = early_stopping.get("rest_worth_db")
    row = (
        name,
        f"{100 * data['refine_share']:.0f}",
        *(f"{data[k]:,}" for k in ("iterations_run", "iterations_skipped")),
        f"{sum(data['always_run'].values()):,}",
        {None: "-", True: "yes", False: "no"}[early_stopping.get("ended_early")],
        "-" if worth is None else f"{worth:.2f}",
    )
    return Table(caption, REFINEMENT_HEADING, [row])


def settings_table(caption: str, settings: dict[str, Any]) -> Table:
    return Table(caption, ("name", "value"), list(flat(settings).items()), text=True)


def picture(figure: Any, caption: str) -> Picture:
    return Picture(plots.inline_svg(figure), caption)


def rounded(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
