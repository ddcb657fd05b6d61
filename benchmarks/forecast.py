"""How far the forecasts of `skipgs-plug estimate` are from whole runs.

    python benchmarks/forecast.py pilot fern               # half a minute of training, and what is forecast from it
    python benchmarks/forecast.py run fern 7000 own        # one whole run with its peak of memory: own or auto
    python benchmarks/forecast.py compare                  # errors of all forecasts whose runs are stored

Numbers of Gaussians are also compared with the runs that `skipgs-plug bench --whole` stored in
`benchmarks/results/bench`, the mean of their seeds. Each run is one process on one thread, in processor seconds, which
other work on a machine changes less than those on the wall: give the pilot and the runs of a scene one after another.
Scenes and settings are the bench's (`--grow-grad2d 0.001`, Lego from 10,000 points). Writes
`benchmarks/results/forecast.json` and, with `compare`, `skipgs_plug/forecast/errors.json`, which the command prints.
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
from skipgs_plug.forecast.pilot import Pilot, Sample, run_pilot
from skipgs_plug.forecast.predict import predict
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.files import write_json

FILE = RESULTS / "forecast.json"
FOLDERS = {"fern": ("fern", 2), "lego": ("lego_200", 1), "bonsai": ("bonsai", 4), "bonsai_large": ("bonsai", 1)}
LENGTHS = (7000, 30_000)
SECONDS = 30.0


def settings(name: str, steps: int, load: bool = True) -> tuple[TrainConfig, Scene | None]:
    """Return the settings of a run, and its scene if it is to be loaded."""
    folder, factor = FOLDERS[name]
    path = str(SCENES / folder)
    config = TrainConfig(
        data_dir=path, data_factor=factor, max_steps=steps, seed=0, grow_grad2d=0.001, init_num_pts=10_000
    )
    return config, load_scene(path, factor, config.test_every, config.init_num_pts) if load else None


def measure(name: str, steps: int, how: str) -> dict[str, Any]:
    """Train to the end, and return what that took."""
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
        "scene": name,
        "max_steps": steps,
        "how": how,
        "seconds": trainer.clock.processor.total,
        "iterations": trainer.ran,
        "gaussians": trainer.num_gaussians,
        "memory": None if meter is None else meter.peak(),
        "provenance": provenance(),
    }


def pilot(name: str) -> dict[str, Any]:
    """Return half a minute of training, and what is forecast from it."""
    config, scene = settings(name, LENGTHS[0])
    assert scene is not None
    seen = run_pilot(config, scene, SECONDS, by_processor=True)
    return {
        "scene": name,
        "iterations": len(seen.samples),
        "gaussians": seen.samples[-1].gaussians,
        "forecasts": [dataclasses.asdict(predict(seen, config, steps)) for steps in LENGTHS],
        "pilot": {
            **dataclasses.asdict(seen),
            "samples": [(one.step, one.gaussians, round(one.seconds, 6)) for one in seen.samples],
        },
        "provenance": provenance(),
    }


def bench_runs() -> list[dict[str, Any]]:
    """Return the whole runs that the bench has stored, as `measure` has them."""
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
                        "seconds": None,  # of another day, and of another state of the machine
                        "gaussians": mean(run["metrics"]["num_GS"] for run in of_policy),
                        "memory": None,
                        "provenance": str(path.relative_to(RESULTS.parents[1])),
                    }
                )
    return runs


def compare(stored: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row for each quantity that was forecast and measured."""
    rows = []
    for seen in stored["pilots"]:
        pilot = Pilot(**{**seen["pilot"], "samples": tuple(Sample(*sample) for sample in seen["pilot"]["samples"])})
        for run in (*stored["runs"], *bench_runs()):
            if run["scene"] != seen["scene"]:
                continue
            config, _ = settings(run["scene"], run["max_steps"], load=False)
            forecast = dataclasses.asdict(predict(pilot, config, run["max_steps"]))
            found = {"seconds" if run["how"] == "own" else "seconds_auto": run["seconds"]}
            found |= {"gaussians": run["gaussians"], "memory": run["memory"]}
            rows += [
                {
                    "scene": run["scene"],
                    "max_steps": run["max_steps"],
                    "how": run["how"],
                    "quantity": quantity,
                    "expected": forecast[quantity],
                    "measured": found[quantity],
                }
                for quantity in QUANTITIES
                if found.get(quantity) is not None and forecast[quantity] is not None
            ]
    return rows


def main(arguments: list[str]) -> None:
    torch.set_num_threads(1)
    set_num_threads(1)
    stored = json.loads(FILE.read_text()) if FILE.exists() else {"pilots": [], "runs": []}
    if arguments[0] == "run":
        name, steps, how = arguments[1], int(arguments[2]), arguments[3]
        found = measure(name, steps, how)
        same = ("scene", "max_steps", "how")
        stored = json.loads(FILE.read_text()) if FILE.exists() else stored  # others may have written meanwhile
        stored["runs"] = [run for run in stored["runs"] if any(run[key] != found[key] for key in same)] + [found]
        write_json(FILE, stored)
        print({key: value for key, value in found.items() if key != "provenance"})
    elif arguments[0] == "pilot":
        found = pilot(arguments[1])
        stored = json.loads(FILE.read_text()) if FILE.exists() else stored
        stored["pilots"] = [one for one in stored["pilots"] if one["scene"] != found["scene"]] + [found]
        write_json(FILE, stored)
        print(found["forecasts"])
    else:
        rows = compare(stored)
        write_json(ERRORS, {"provenance": "benchmarks/forecast.py compare", "rows": rows})
        for row in rows:
            print(f"{row['scene']:14} {row['max_steps']:6,} {row['how']:4} {row['quantity']:14} {error(row):+7.1%}")


if __name__ == "__main__":
    main(sys.argv[1:])
