"""Errors of the forecasts of `skipgs-plug estimate`, compared with whole runs.

    python benchmarks/forecast.py fern             # a few seconds of training, then a whole run with share="auto"
    python benchmarks/forecast.py lego own         # and a run that leaves nothing out
    python benchmarks/forecast.py compare          # errors of all forecasts whose runs are stored

Numbers of Gaussians are also compared with the runs that `skipgs-plug bench --whole` stored in
`benchmarks/results/bench`, as the mean of their seeds. All runs of a scene share a process and one thread. They are
compared in processor seconds, which depend less on other programs than wall-clock seconds. Scenes and settings are
those of the bench (`--grow-grad2d 0.001`, Lego from 10,000 points); `fern_defaults` has the defaults of `train`. Writes
`benchmarks/results/forecast.json` and `skipgs_plug/forecast/errors.json`, which the command prints. Run it again when
the rule of `share="auto"` changes.
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
from skipgs_plug.forecast.pilot import PILOT_STEPS, run_pilot
from skipgs_plug.forecast.predict import predict
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.files import write_json

FILE = RESULTS / "forecast.json"
# Folder, data_factor and grow_grad2d of each scene.
SETTINGS = {
    "fern": ("fern", 2, 0.001),
    "fern_defaults": ("fern", 2, TrainConfig.grow_grad2d),
    "lego": ("lego_200", 1, 0.001),
    "bonsai": ("bonsai", 4, 0.001),
}
# Processor seconds of training from which a forecast is made. The half minute of the command would be nearly all of a
# run on such small scenes, and so no forecast: of a large scene it is a small part, as these seconds are here.
SECONDS = {"fern": 5.0, "fern_defaults": 20.0, "lego": 2.5, "bonsai": 5.0}
LENGTHS = (3000, 6000, 7000, 30_000)  # iterations of the bench's runs, and of the runs made here
RUN = 7000  # iterations of a run made here


def settings(name: str, steps: int) -> tuple[TrainConfig, Scene]:
    """Return the settings of a run, and its scene."""
    folder, factor, threshold = SETTINGS[name]
    path = str(SCENES / folder)
    config = TrainConfig(
        data_dir=path, data_factor=factor, max_steps=steps, seed=0, grow_grad2d=threshold, init_num_pts=10_000
    )
    return config, load_scene(path, factor, config.test_every, config.init_num_pts)


def measure(name: str, steps: int, how: str) -> dict[str, Any]:
    """Train to the end, and return the measured quantities."""
    config, scene = settings(name, steps)
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
    """Return the forecasts from the first seconds of training."""
    config, scene = settings(name, RUN)
    trial = run_pilot(config, scene, SECONDS[name], by_processor=True)
    return {
        "iterations": len(trial.samples),
        "gaussians": trial.samples[-1].gaussians,
        "grown": trial.samples[-1].step >= trial.stop,
        "forecasts": [dataclasses.asdict(predict(trial, config, steps)) for steps in LENGTHS],
    }


def bench_runs() -> list[dict[str, Any]]:
    """Return the whole runs of every iteration that the bench stored, in the form of `measure`.

    Runs of `share="auto"` are left out, because several were made by earlier rules, and so are times and memory, which
    were measured on other days and machines.
    """
    names = {scene: name for name, scene in SETTINGS.items()}
    runs = []
    for path in sorted((RESULTS / "bench").glob("*_whole/bench.json")):
        result = json.loads(path.read_text("utf-8"))
        training, scene = result["settings"]["training"], result["settings"]["scene"]
        own = [run for run in result["runs"] if run["policy"] == "own" and run["status"] == "done"]
        runs.append(
            {
                "scene": names[scene["name"], scene["data_factor"], training["grow_grad2d"]],
                "max_steps": training["max_steps"],
                "how": "own",
                "seconds": None,
                "iterations": training["max_steps"],
                "gaussians": mean(run["metrics"]["num_GS"] for run in own),
                "memory": None,
            }
        )
    return runs


def compare(stored: dict[str, Any], bench: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row for each quantity that was both forecast and measured.

    `part` is the share of the run's iterations that the pilot trained. A pilot that saw the end of densification knows
    the run of its own schedule, so its errors there do not count.
    """
    rows = []
    for name, scene in stored.items():
        pilot = scene["pilot"]
        forecasts = {forecast["max_steps"]: forecast for forecast in pilot["forecasts"]}
        for run in (*scene["runs"], *(run for run in bench if run["scene"] == name)):
            if pilot["grown"] and run["max_steps"] == PILOT_STEPS:
                continue
            forecast, auto = forecasts[run["max_steps"]], run["how"] == "auto"
            found = {"gaussians": run["gaussians"], "memory": run["memory"]}
            found["seconds_auto" if auto else "seconds"] = run["seconds"]
            found |= {"iterations_auto": run["iterations"]} if auto else {}
            about = {"scene": name, "max_steps": run["max_steps"], "how": run["how"]}
            about["part"] = round(pilot["iterations"] / run["iterations"], 3)
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
    if name in SETTINGS:
        found = {"provenance": provenance(), "pilot": pilot(name)}
        found["runs"] = [measure(name, RUN, how) for how in ("auto", *more)]
        stored[name] = found
        write_json(FILE, stored)
    rows = compare(stored, bench_runs())
    write_json(ERRORS, {"provenance": "benchmarks/forecast.py", "rows": rows})
    for row in rows:
        print(f"{row['scene']:13} {row['max_steps']:6,} {row['how']:4} {row['quantity']:15} {error(row):+7.1%}")


if __name__ == "__main__":
    main(sys.argv[1:])
