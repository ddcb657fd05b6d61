"""What a folder holds: a gated run (ours or a script's), or a bench."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from skipgs_plug.bench.decisions import FILE as DECISIONS
from skipgs_plug.bench.decisions import read_decisions
from skipgs_plug.bench.record import Trace
from skipgs_plug.bench.result import KIND
from skipgs_plug.bench.result import SCHEMA_VERSION as BENCH_VERSION
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.report import SCHEMA_VERSION as RUN_VERSION

RUN_FIELDS = (
    "settings",
    "iterations",
    "gated_iterations",
    "backwards_run",
    "backwards_skipped",
    "min_bwd_ratio_effective",
    "paused",
    "non_finite",
    "reasons",
    "t_total",
    "t_post",
    "views",
)
BENCH_FIELDS = ("command", "commits", "versions", "settings", "refinement", "rows", "ceiling", "timing_noise", "runs")
BENCH_PICTURES = {
    "psnr_over_time.png": "Held-out PSNR against seconds of refinement, one curve per policy.",
    "time_against_error.png": "Refinement time against final held-out PSNR, with spread over seeds.",
    "phases.png": "Seconds of refinement in forward, loss, backward and optimizer, one bar per policy.",
    "skipped_views.png": "Which visits of which training view were skipped, over iterations.",
    "loss_and_mean.png": "Loss of single views against their running mean; skipped visits are hollow.",
}
RENDERS_SHOWN = 3


@dataclass
class RunSource:
    """A gated run.

    Attributes:
        data: content of skipgs.json.
        metrics: of the last evaluation that the run folder holds in gsplat's layout; empty without.
        renders: some pictures, truth beside render.
    """

    name: str
    path: Path
    data: dict[str, Any]
    metrics: dict[str, Any] = field(default_factory=dict)
    renders: list[Path] = field(default_factory=list)


@dataclass
class BenchSource:
    """A bench: content of bench.json, the pictures beside it with what they show, and its decisions if it has them."""

    name: str
    path: Path
    data: dict[str, Any]
    pictures: list[tuple[Path, str]]
    decisions: dict[tuple[int, str], Trace] = field(default_factory=dict)


def read_source(path: str | Path) -> RunSource | BenchSource:
    """Read a run folder, a bench folder, or the JSON file of either.

    Raises:
        SkipGSError: there is none, or it is damaged or of another version; names the file.
    """
    path = Path(path)
    if path.is_file():
        folder, file = path.parent, path
    else:
        folder = path
        file = folder / "bench.json" if (folder / "bench.json").is_file() else folder / "skipgs.json"
    if not file.is_file():
        if (folder / "settings.json").is_file() and (folder / "runs").is_dir():
            raise SkipGSError(f"{folder} holds a bench that has not finished; give its command again to continue it.")
        raise SkipGSError(
            f"{file} does not exist; give the folder of a gated run (skipgs-plug train or run) or of a bench."
        )
    data = read_object(file)
    name = folder.resolve().name
    if data.get("kind") == KIND:
        require(file, data, BENCH_FIELDS, BENCH_VERSION)
        pictures = [(folder / p, text) for p, text in BENCH_PICTURES.items() if (folder / p).is_file()]
        decisions = read_decisions(folder / DECISIONS) if (folder / DECISIONS).is_file() else {}
        return BenchSource(name, folder, data, pictures, decisions)
    require(file, data, RUN_FIELDS, RUN_VERSION)
    metrics, renders = last_evaluation(folder)
    return RunSource(name, folder, data, metrics, renders)


def read_object(file: Path) -> dict[str, Any]:
    try:
        data = json.loads(file.read_text())
    except (ValueError, OSError) as error:
        raise SkipGSError(f"{file} is damaged ({error}); run it again, or leave it out.") from error
    if not isinstance(data, dict):
        raise SkipGSError(f"{file} holds no JSON object; it was not written by this package.")
    return data


def require(file: Path, data: dict[str, Any], fields: tuple[str, ...], version: int) -> None:
    if data.get("schema_version") != version:
        raise SkipGSError(
            f"{file} has schema version {data.get('schema_version')!r}, this package reads {version}; "
            "use the version that wrote it."
        )
    missing = [name for name in fields if name not in data]
    if missing:
        raise SkipGSError(f"{file} is damaged (no {missing[0]!r} in it); run it again, or leave it out.")


def last_evaluation(folder: Path) -> tuple[dict[str, Any], list[Path]]:
    """Return metrics and renders of the last evaluation in gsplat's layout, if the folder has that."""
    found = [(step_of(path), path) for path in (folder / "stats").glob("val_step*.json")]
    if not found:
        return {}, []
    step, path = max(found)
    renders = sorted((folder / "renders").glob(f"val_step{step}_*.png"))
    every = max(1, len(renders) // RENDERS_SHOWN)
    return read_object(path), renders[::every][:RENDERS_SHOWN]


def step_of(path: Path) -> int:
    digits = path.stem.removeprefix("val_step")
    return int(digits) if digits.isdigit() else -1
