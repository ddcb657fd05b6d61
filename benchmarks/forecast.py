"""Errors of the forecasts of `skipgs-plug estimate`, compared with whole runs.

    python benchmarks/forecast.py fern             # half a minute of training, then a whole run with share="auto"
    python benchmarks/forecast.py lego own         # and a run that leaves nothing out
    python benchmarks/forecast.py compare          # errors of all forecasts whose runs are stored

Numbers of Gaussians are also compared with the runs that `skipgs-plug bench --whole` stored in
`benchmarks/results/bench`, as the mean of their seeds. All runs of a scene share a process and one thread. They are
compared in processor seconds, which depend less on other programs than wall-clock seconds. Scenes and settings are
those of the bench (`--grow-grad2d 0.001`, Lego from 10,000 points). Writes `benchmarks/results/forecast.json` and
`skipgs_plug/forecast/errors.json`, which the command prints. Run it again when the rule of `share="auto"` changes.
"""

import dataclasses
import json
import sys
from statistics import fmean as mean
from typing import Any

import torch
from common import RESULTS, SCENES, provenance

from skipgs_plug import SkipGate
from skipgs_plug.bench.memory import memory_meter
from skipgs_plug.fallback_raster import set_num_threads
from skipgs_plug.forecast.errors import FILE as ERRORS
from skipgs_plug.forecast.errors import QUANTITIES, error
from skipgs_plug.forecast.pilot import run_pilot
from skipgs_plug.forecast.predict import predict
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.files import write_json

FILE = RESULTS / "forecast.json"
FOLDERS = {"fern": ("fern", 2), "lego": ("lego_200", 1), "bonsai": ("bonsai", 4), "bonsai_large": ("bonsai", 1)}
LENGTHS = (3000, 7000)  # iterations of the bench's runs on fern and bonsai, and of the runs made here
RUN = 7000  # iterations of a run made here
SECONDS = 30.0  # seconds of training from which a forecast is made


def settings(name: str, steps: int, load: bool = True) -> tuple[TrainConfig, Scene | None]:
    """Return the settings of a run, and its scene if it is to be loaded."""
    folder, factor = FOLDERS[name]
    path = str(SCENES / folder)
    config = TrainConfig(
        data_dir=path, data_factor=factor, max_steps=steps, seed=0, grow_grad2d=0.001, init_num_pts=10_000
    )
    return config, load_scene(path, factor, config.test_every, config.init_num_pts) if load else None


def measure(name: str, steps: int, how: str) -> dict[str, Any]:
    """Train to the end, and return the measured quantities."""
    config, scene = settings(name, steps)
    assert scene is not None
    trainer = Trainer(config, scene)
    meter = memory_meter(trainer.backend.device)
    if meter is not None:
        meter.reset()
    if how == "auto":
        SkipGate(trainer, share="auto")
    trainer.train(progress=False)
    return {
        "max_steps": steps,
        "how": how,
        "seconds": trainer.clock.processor.total,
        "iterations": trainer.ran,
        "gaussians": trainer.num_gaussians,
        "memory": None if meter is None else meter.peak(),
    }


def pilot(name: str) -> dict[str, Any]:
    """Return the forecasts from half a minute of training."""
    config, scene = settings(name, RUN)
    assert scene is not None
    trial = run_pilot(config, scene, SECONDS, by_processor=True)
    return {
        "iterations": len(trial.samples),
        "gaussians": trial.samples[-1].gaussians,
        "forecasts": [dataclasses.asdict(predict(trial, config, steps)) for steps in LENGTHS],
    }


def bench_runs() -> list[dict[str, Any]]:
    """Return the whole runs that the bench stored, in the form of `measure`."""
    names = {folder: name for name, (folder, _) in FOLDERS.items()}
    runs = []
    for path in sorted((RESULTS / "bench").glob("*_whole/bench.json")):
        result = json.loads(path.read_text("utf-8"))
        for policy, how in (("own", "own"), ("share=auto", "auto")):
            of_policy = [run for run in result["runs"] if run["policy"] == policy and run["status"] == "done"]
            if of_policy:
                training = result["settings"]["training"]
                runs.append(
                    {
                        "scene": names[result["settings"]["scene"]["name"]],
                        "max_steps": training["max_steps"],
                        "how": how,
                        "seconds": None,  # measured on another day, in another state of the machine
                        "gaussians": mean(run["metrics"]["num_GS"] for run in of_policy),
                        "memory": None,
                        "provenance": str(path.relative_to(RESULTS.parents[1])),
                    }
                )
    return runs


def compare(stored: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row for each quantity that was both forecast and measured."""
    rows = []
    for name, scene in stored.items():
        forecasts = {forecast["max_steps"]: forecast for forecast in scene["pilot"]["forecasts"]}
        for run in (*scene["runs"], *(run for run in bench_runs() if run["scene"] == name)):
            if (forecast := forecasts.get(run["max_steps"])) is None:
                continue
            found = {"seconds" if run["how"] == "own" else "seconds_auto": run["seconds"]}
            found |= {"gaussians": run["gaussians"], "memory": run["memory"]}
            about = {"scene": name, "max_steps": run["max_steps"], "how": run["how"]}
            rows += [
                {**about, "quantity": quantity, "expected": forecast[quantity], "measured": found[quantity]}
                for quantity in QUANTITIES
                if found.get(quantity) is not None and forecast[quantity] is not None
            ]
    return rows


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    set_num_threads(1)
    stored = json.loads(FILE.read_text()) if FILE.exists() else {}
    name, *more = arguments
    if name in FOLDERS:
        found = {"provenance": provenance(), "pilot": pilot(name)}
        found["runs"] = [measure(name, RUN, how) for how in ("auto", *more)]
        stored[name] = found
        write_json(FILE, stored)
    rows = compare(stored)
    write_json(ERRORS, {"provenance": "benchmarks/forecast.py", "rows": rows})
    for row in rows:
        print(f"{row['scene']:14} {row['max_steps']:6,} {row['how']:4} {row['quantity']:14} {error(row):+7.1%}")


if __name__ == "__main__":
    main(sys.argv[1:])
