"""One training iteration of a large model at full resolution: 3,000,000 Gaussians on 1920x1080 pixels.

    python benchmarks/large.py [--gaussians 3000000] [--iterations 5]

The scene has the points of "garden", and copies that are moved by about a point's size. Its three cameras have smooth
noise as photographs, since the time depends on positions and sizes only. Runs the reference trainer after densification
at SH degree 3 on all cores that it may use. Prints and writes `benchmarks/results/large.json`: processor seconds of
each phase, wall-clock seconds of the fastest iteration, seconds of the slowest kernels, and the peak memory of the
process.
"""

import itertools
import resource
import sys
from typing import Any

import numpy as np
import torch
import tyro
from common import RESULTS, SCENES, kernel_seconds, provenance, write_part
from iteration import resampled

from skipgs_plug.fallback_raster import get_num_threads
from skipgs_plug.trainer import Scene, TrainConfig, Trainer
from skipgs_plug.trainer.clock import PHASES, TrainClock
from skipgs_plug.trainer.scene import View, assemble_scene

FILE = RESULTS / "large.json"
WARM_UP = 5  # iterations after which the SH degree has its maximum and all buffers their size
KERNELS = 8  # kernels that are listed, those with the most time


def garden(width: int, height: int) -> Scene:
    """Return the SfM points with three cameras and photographs of noise that is smooth over 8 pixels."""
    with np.load(SCENES / "garden_points.npz") as file:
        data = dict(file)
    factor = np.array([[width / float(data["width"])], [height / float(data["height"])], [1.0]])
    generator = torch.Generator().manual_seed(0)
    views = []
    for i, (viewmat, K) in enumerate(zip(data["viewmats"], data["Ks"], strict=True)):
        coarse = torch.rand(1, 3, height // 8, width // 8, generator=generator)
        image = torch.nn.functional.interpolate(coarse, (height, width), mode="bilinear")[0].permute(1, 2, 0)
        pose, intrinsics = torch.from_numpy(viewmat).double(), torch.from_numpy(K * factor).float()
        views.append(View(f"view_{i}.png", (image * 255).byte().contiguous(), intrinsics, pose))
    return assemble_scene(SCENES / "garden_points.npz", "garden", views, [], data["means3d"], data["colors"])


def measure(scene: Scene, iterations: int) -> dict[str, Any]:
    """Return seconds per iteration: mean processor seconds, and the smallest wall-clock seconds."""
    config = TrainConfig(sh_degree_interval=1, refine_stop_iter=1, backend="warp")
    trainer = Trainer(config, scene)
    trainer.clock = TrainClock(trainer.backend.device, by_processor=True)
    trainer.train(until=WARM_UP, progress=False)
    before, total = dict(trainer.phase_seconds), trainer.t_total
    walls = [trainer.clock.wall.total]
    trainer.on_step = lambda iteration: walls.append(trainer.clock.wall.total)
    with kernel_seconds() as kernels:
        trainer.train(until=WARM_UP + iterations, progress=False)
    if len(trainer.splats["means"]) != len(scene.points):
        raise RuntimeError("The run changed its number of Gaussians; the times would mean nothing.")
    most = sorted(kernels.items(), key=lambda pair: -pair[1])[:KERNELS]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return {
        "seconds": (trainer.t_total - total) / iterations,
        "wall_fastest": min(after - before for before, after in itertools.pairwise(walls)),
        "phases": {name: (trainer.phase_seconds[name] - before[name]) / iterations for name in PHASES},
        "kernels_wall": {name: seconds / iterations for name, seconds in most},
        "peak_gib": peak / 2**30,
        "threads": get_num_threads(),
    }


def main(gaussians: int = 3_000_000, width: int = 1920, height: int = 1080, iterations: int = 5) -> None:
    """Measure, print and write one row."""
    about = provenance()
    row = {"gaussians": gaussians, "width": width, "height": height, "iterations": iterations}
    row |= measure(resampled(garden(width, height), gaussians), iterations)
    phases = ", ".join(f"{name} {seconds:.2f}" for name, seconds in row["phases"].items())
    print(f"{about['cpu']}, {row['threads']} threads, commit {about['commit']}")
    print(
        f"{gaussians:,} Gaussians, {width}x{height}: {row['seconds']:.2f} s of processors ({phases}), "
        f"{row['wall_fastest']:.2f} s on the wall, {row['peak_gib']:.1f} GiB"
    )
    print(", ".join(f"{name} {seconds:.2f}" for name, seconds in row["kernels_wall"].items()))
    write_part(FILE, f"{gaussians} on {width}x{height}, {row['threads']} threads", row, about)


if __name__ == "__main__":
    tyro.cli(main)
