"""Seconds from the command to the picture: whole fresh processes of `skipgs-plug train`, loading and saving included.

    python benchmarks/time_to_picture.py fern --steps 500 700 900
    python benchmarks/time_to_picture.py bonsai --steps 1500 2000

Trains the scene once for each length of schedule with `--share auto`, as a user would, and prints the seconds on the
wall, those for which processors worked, and PSNR on held-out views. Kernels are compiled beforehand by a run of one
iteration. The aim is the quality that OpenSplat's trainer reaches on fern, and 29.5 dB on bonsai. Writes one row per
run to `benchmarks/results/time_to_picture.json`, with the load of the machine: where other programs ran, only
processor seconds mean something.
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
# Folder, further options, PSNR to reach in dB.
AIMS = {
    "fern": ("fern", ["--data-factor", "2"], 27.4),
    "bonsai": ("bonsai", [], 29.5),
}


@dataclass
class Args:
    """Measure the time from the command to the picture."""

    scene: Annotated[Literal["fern", "bonsai"], tyro.conf.Positional]
    """What to train."""
    steps: tuple[int, ...] = (700, 1000, 1400)
    """Lengths of schedules."""
    more: tuple[str, ...] = ("--share", "auto", "--grow-grad2d", "0.001")
    """Further options of the command."""


def train(scene: Path, options: list[str], steps: int, folder: Path) -> dict[str, Any]:
    """Run one process to its end, and return its times and what its picture is worth."""
    command = [sys.executable, "-m", "skipgs_plug", "train", str(scene), "--out", str(folder), "--no-progress"]
    command += ["--max-steps", str(steps), *options]
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    wall, after = time.perf_counter() - begun, resource.getrusage(resource.RUSAGE_CHILDREN)
    stats = json.loads((folder / f"stats/val_step{steps - 1}.json").read_text())
    report = folder / "skipgs.json"
    training = json.loads(report.read_text())["t_total_processor"] if report.exists() else None
    return {
        "max_steps": steps,
        "wall": wall,
        "processor": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
        "training_processor": training,
        "psnr": stats["psnr"],
        "gaussians": stats["num_GS"],
    }


def main(args: Args) -> None:
    folder, options, aim = AIMS[args.scene]
    scene = SCENES / folder
    rows = []
    with tempfile.TemporaryDirectory() as root:
        train(scene, [*options, *args.more], 1, Path(root) / "compiled")
        for steps in args.steps:
            load = os.getloadavg()[0]
            row = train(scene, [*options, *args.more], steps, Path(root) / str(steps)) | {"load_before": load}
            rows.append(row)
            print(
                f"{args.scene} {steps:6,} iterations: {row['wall']:6.1f} s on the wall, {row['processor']:6.1f} s of "
                f"processors, PSNR {row['psnr']:.2f} dB ({'reaches' if row['psnr'] >= aim else 'misses'} {aim}), "
                f"{row['gaussians']:,} Gaussians; load of the machine before {load:.1f}"
            )
    about = {"aim_db": aim, "options": [*options, *args.more], "cores": usable_cores(), **provenance()}
    write_part(FILE, args.scene, rows, about)


if __name__ == "__main__":
    main(tyro.cli(Args))
