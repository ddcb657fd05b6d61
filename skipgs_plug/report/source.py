"""Read the content of a folder: a run of this package's trainer or of a script, or a bench."""

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
from skipgs_plug.files import BENCH_SETTINGS, printable

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
    "skipped_views.png": "Skipped visits of each training view over iterations.",
    "loss_and_mean.png": "Loss of single views against their running mean; skipped visits are hollow.",
}
SPLITS = {"val": "held-out", "train": "training"}  # views that were evaluated, by the beginning of file names
EVALUATIONS = "stats/{}_step*.json"
NO_STEP = -1
CURVE = "train_curve.json"
CURVE_FIELDS = ("step", "seconds", "loss", "num_GS")


@dataclass
class RunSource:
    """A run, with or without a gate.

    Attributes:
        name: Name of the run's folder.
        path: The folder.
        gate: Content of skipgs.json; None if the run has no gate.
        metrics: Metrics of the last evaluation in gsplat's file layout; empty if there is none.
        views: Metrics of each evaluated view, in the order of `renders`; empty if the trainer wrote none.
        renders: Pictures of that evaluation, each with the photograph and the render.
        curve: Columns `step`, `seconds`, `loss`, `num_GS` of the training curve; empty if the trainer wrote none.
        settings: Settings of the training; empty if unknown.
        split: Which views were evaluated: held-out ones, or the training views of a run that held out none.
    """

    name: str
    path: Path
    gate: dict[str, Any] | None
    metrics: dict[str, Any] = field(default_factory=dict)
    views: list[dict[str, Any]] = field(default_factory=list)
    renders: list[Path] = field(default_factory=list)
    curve: dict[str, list[float]] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    split: str = SPLITS["val"]

    @property
    def t_total(self) -> float | None:
        """Training time in seconds; None if unknown."""
        seconds = self._seconds("t_total")
        if seconds is None and self.curve.get("seconds"):
            return self.curve["seconds"][-1]
        return seconds

    @property
    def t_post(self) -> float | None:
        """Training time after densification in seconds; None if unknown."""
        return self._seconds("t_post")

    def _seconds(self, name: str) -> float | None:
        value = (self.metrics if self.gate is None else self.gate).get(name)
        return None if value is None else float(value)


@dataclass
class BenchSource:
    """A bench: the content of bench.json, its plots with captions, and the decisions of its policies if stored."""

    name: str
    path: Path
    data: dict[str, Any]
    pictures: list[tuple[Path, str]]
    decisions: dict[tuple[int, str], Trace] = field(default_factory=dict)


def read_source(path: str | Path) -> RunSource | BenchSource:
    """Read the folder of a run or of a bench, or the JSON file of either.

    Raises:
        SkipGSError: The file is missing, damaged or of another version. The message names the file.
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise SkipGSError(f"{path} does not exist; give the folder of a run or of a bench.")
    if path.is_file():
        if path.suffix.lower() != ".json":
            raise SkipGSError(f"{path} is not the skipgs.json or bench.json of a run; give the run's folder.")
        folder, file = path.parent, path
    else:
        folder = path
        file = folder / "bench.json" if (folder / "bench.json").is_file() else folder / "skipgs.json"
    name = printable(folder.resolve().name)
    if not file.is_file():
        if (folder / BENCH_SETTINGS).is_file() and (folder / "runs").is_dir():
            raise SkipGSError(f"{folder} holds a bench that has not finished; repeat its command to continue it.")
        run = read_run(name, folder, None)
        if not run.metrics and not run.curve:
            raise SkipGSError(
                f"{folder} holds neither skipgs.json, bench.json nor {EVALUATIONS.format('val')}; give the folder of a "
                "finished run (skipgs-plug train or run), or of a bench."
            )
        return run
    data = read_object(file)
    if data.get("kind") == KIND:
        require(file, data, BENCH_FIELDS, BENCH_VERSION)
        pictures = [(folder / p, text) for p, text in BENCH_PICTURES.items() if (folder / p).is_file()]
        decisions = read_decisions(folder / DECISIONS) if (folder / DECISIONS).is_file() else {}
        return BenchSource(name, folder, data, pictures, decisions)
    require(file, data, RUN_FIELDS, RUN_VERSION)
    return read_run(name, folder, data)


def read_run(name: str, folder: Path, gate: dict[str, Any] | None) -> RunSource:
    """Read all files of a run folder except skipgs.json, whose content is `gate`."""
    beginning, metrics, renders = last_evaluation(folder)
    views = metrics.pop("per_view", [])
    curve = folder / "stats" / CURVE
    columns = read_object(curve) if curve.is_file() else {}
    if columns and not all(isinstance(columns.get(name), list) for name in CURVE_FIELDS):
        raise SkipGSError(f"{curve} is damaged (it lacks one of {', '.join(CURVE_FIELDS)}); remove it.")
    split = SPLITS[beginning]
    return RunSource(name, folder, gate, metrics, views, renders, columns, read_settings(folder), split)


def read_settings(folder: Path) -> dict[str, Any]:
    """Return the training settings in cfg.yml; empty if the file is missing or contains Python objects."""
    import yaml

    file = folder / "cfg.yml"
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8")) if file.is_file() else {}
    except (yaml.YAMLError, UnicodeDecodeError):
        return {}
    return content if isinstance(content, dict) else {}


def read_object(file: Path) -> dict[str, Any]:
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise SkipGSError(f"{file} is damaged ({error}); repeat the run, or leave the file out.") from error
    if not isinstance(data, dict):
        raise SkipGSError(f"{file} holds no JSON object; this package did not write it.")
    return data


def require(file: Path, data: dict[str, Any], fields: tuple[str, ...], version: int) -> None:
    if data.get("schema_version") != version:
        raise SkipGSError(
            f"{file} has schema version {data.get('schema_version')!r}, but this package reads {version}; "
            "use the version of the package that wrote the file."
        )
    missing = [name for name in fields if name not in data]
    if missing:
        raise SkipGSError(f"{file} is damaged (no {missing[0]!r} in it); repeat the run, or leave the file out.")


def last_evaluation(folder: Path) -> tuple[str, dict[str, Any], list[Path]]:
    """Return the last evaluation in gsplat's file layout: a key of `SPLITS`, metrics, and pictures.

    Metrics and pictures are empty if there is none. Training views count if no held-out ones were evaluated.
    `train_step6999_rank0.json`, which gsplat's script writes, is no evaluation: it holds time and memory.
    """
    for beginning in SPLITS:
        found = [(step_of(path), path) for path in folder.glob(EVALUATIONS.format(beginning))]
        step, path = max(found, default=(NO_STEP, folder))
        if step != NO_STEP:
            return beginning, read_object(path), sorted((folder / "renders").glob(f"{beginning}_step{step}_*.png"))
    return "val", {}, []


def step_of(path: Path) -> int:
    digits = path.stem.partition("_step")[2]
    return int(digits) if digits.isdigit() else NO_STEP
