"""Seconds from the command to the picture: new processes of `skipgs-plug train`, with loading and saving included.

    python benchmarks/time_to_picture.py fern --schedules 3000:auto 3000:0.1 3000:0.12
    python benchmarks/time_to_picture.py bonsai --schedules 7000:auto 6000:0.12 --repeats 1

Trains the scene with each schedule (`--max-steps` and `--share`), as a user would. Prints wall-clock seconds, processor
seconds, and PSNR on held-out views, of the fastest repeat. A run of one iteration compiles all kernels before. The
target is the quality of OpenSplat's trainer on fern, and 29.5 dB on bonsai with `images_4`. Writes one row per schedule
to `benchmarks/results/time_to_picture.json`, with the load of the machine and the seconds that importing torch takes.
No program here can save that import, which takes about one second on an idle machine.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from common import RESULTS, SCENES, provenance, write_part

from skipgs_plug.fallback_raster.runtime.cores import usable_cores

FILE = RESULTS / "time_to_picture.json"
# By scene: folder, further options, and PSNR to reach in dB.
AIMS = {
    "fern": ("fern", ["--data-factor", "2"], 27.4),
    "bonsai": ("bonsai", ["--data-factor", "4"], 29.5),
}


@dataclass
class Args:
    """Measure the time from the command to the picture."""

    scene: Annotated[Literal["fern", "bonsai"], tyro.conf.Positional]
    """Scene to train."""
    schedules: tuple[str, ...] = ("3000:auto", "3000:0.1", "3000:0.12")
    """Schedules: number of iterations, and the share of them that runs."""
    repeats: int = 2
    """Number of processes for each schedule."""
    grow_grad2d: float = 0.001
    """Gradient above which Gaussians are duplicated or split. Smaller values give more Gaussians."""


def processor() -> float:
    """Return the processor seconds of all child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def train(scene: Path, options: list[str], steps: int, folder: Path) -> dict[str, Any]:
    """Run one process to its end, and return its times, PSNR and number of Gaussians."""
    command = [sys.executable, "-m", "skipgs_plug", "train", str(scene), "--out", str(folder), "--no-progress"]
    command += ["--max-steps", str(steps), *options]
    before, begun = processor(), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wall, after = time.perf_counter() - begun, processor()
    stats = json.loads((folder / f"stats/val_step{steps - 1}.json").read_text())
    report = json.loads((folder / "skipgs.json").read_text())
    return {
        "wall": wall,
        "processor": after - before,
        "training_wall": report["t_total"],
        "training_processor": report["t_total_processor"],
        "iterations": report["iterations"],
        "psnr": stats["psnr"],
        "gaussians": stats["num_GS"],
    }


def import_torch() -> float:
    begun = time.perf_counter()
    subprocess.run([sys.executable, "-c", "import torch"], check=True)
    return time.perf_counter() - begun


def main(args: Args) -> None:
    folder, options, aim = AIMS[args.scene]
    scene = SCENES / folder
    rows, given = [], [*options, "--grow-grad2d", str(args.grow_grad2d)]
    with tempfile.TemporaryDirectory() as root:
        train(scene, [*given, "--gate"], 1, Path(root) / "compiled")
        for schedule in args.schedules:
            steps, share = schedule.split(":")
            load, torch, runs = os.getloadavg()[0], import_torch(), []
            for repeat in range(args.repeats):
                out = Path(root) / f"{steps}_{share}_{repeat}"
                runs.append(train(scene, [*given, "--share", share], int(steps), out))
            row = {"max_steps": int(steps), "share": share, **min(runs, key=lambda run: run["wall"])}
            row |= {"walls": [run["wall"] for run in runs], "psnrs": [run["psnr"] for run in runs]}
            rows.append(row | {"load_before": load, "import_torch": torch})
            print(
                f"{args.scene} {schedule}: {row['iterations']:,} iterations, {row['wall']:.1f} s on the wall "
                f"({row['training_wall']:.1f} of them training), {row['processor']:.1f} s of processors, "
                f"PSNR {row['psnr']:.2f} dB ({'reaches' if row['psnr'] >= aim else 'misses'} {aim}), "
                f"{row['gaussians']:,} Gaussians; load before {load:.1f}, importing torch {torch:.1f} s",
                flush=True,
            )
    about = {"aim_db": aim, "options": given, "cores": usable_cores(), **provenance()}
    write_part(FILE, f"{args.scene}, grow_grad2d {args.grow_grad2d:g}", rows, about)


if __name__ == "__main__":
    main(tyro.cli(Args))
