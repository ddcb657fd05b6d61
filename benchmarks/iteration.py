"""Time of one training iteration on the photographs of "fern", by phase: forward, loss, backward, optimizer.

    python benchmarks/iteration.py [--quick] [--scene path/to/fern]

Runs the reference trainer after densification, so the number of Gaussians is constant, with L1 + SSIM and Adam on whole
images of 504x378 pixels. Measures several numbers of Gaussians, SH degrees 0 and 3, and all cores and one. Times are
medians over iterations with different views. Writes `benchmarks/results/iteration.json` and a plot.
"""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import torch
import tyro
from common import RESULTS, SCENES, exponents, median_ms, provenance, threads, write_part

from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene

FILE = RESULTS / "iteration.json"
PHASES = ("forward", "loss", "backward", "optimizer")
WARM_UP = 6  # iterations after which the SH degree has its maximum and all buffers their size

# Milliseconds of OpenSplat bd0400d, the fastest CPU trainer found, for one iteration at SH degree 0 on two cores of an
# AMD EPYC (Zen 5); medians of 24 iterations, three rounds. See docs/how_it_works/rasterizer.md.
PEER = {1_000: 175, 3_000: 202, 10_000: 317, 30_000: 449, 100_000: 821}
PEER_THREADS, PEER_SH_DEGREE = 2, 0
LARGE = (1_000_000, 3_000_000)  # numbers of Gaussians for which no peer was timed


def resampled(scene: Scene, n: int) -> Scene:
    """Return the scene with n of its points. If it has fewer, copies are added, moved by about a point's size."""
    generator = torch.Generator().manual_seed(0)
    count = len(scene.points)
    rows = torch.randperm(count, generator=generator)[:n]
    copies = torch.randint(count, (max(n - count, 0),), generator=generator)
    spread = scene.points.std(dim=0) / count ** (1 / 3)
    moved = scene.points[copies] + spread * torch.randn(len(copies), 3, generator=generator)
    return dataclasses.replace(
        scene,
        points=torch.cat([scene.points[rows], moved]),
        points_rgb=torch.cat([scene.points_rgb[rows], scene.points_rgb[copies]]),
    )


def measure(scene: Scene, sh_degree: int, iterations: int) -> dict[str, Any]:
    """Return medians over the iterations of one run."""
    config = TrainConfig(sh_degree=sh_degree, sh_degree_interval=1, refine_stop_iter=1, backend="warp")
    trainer = Trainer(config, scene)
    trainer.train(until=WARM_UP, progress=False)
    phases: dict[str, list[float]] = {name: [] for name in PHASES}
    whole = []
    for _ in range(iterations):
        before, total = dict(trainer.phase_seconds), trainer.t_total
        trainer.train_step()
        whole.append(trainer.t_total - total)
        for name in PHASES:
            phases[name].append(trainer.phase_seconds[name] - before[name])
    if trainer.active_sh_degree(trainer.step) != sh_degree or len(trainer.splats["means"]) != len(scene.points):
        raise RuntimeError("The run changed its SH degree or its number of Gaussians; the times would mean nothing.")
    return {
        "ms": median_ms(whole),
        "ms_min": 1000 * min(whole),
        "phases_ms": {name: median_ms(values) for name, values in phases.items()},
    }


def plot(rows: list[dict[str, Any]]) -> None:
    """Plot the phases of each row, stacked, and the peer as a line."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    most = max(row["threads"] for row in rows)
    rows = [row for row in rows if row["threads"] == most]
    figure, axis = plt.subplots(figsize=(11, 5), layout="constrained")
    labels = [f"{row['gaussians'] // 1000:,}k\nSH {row['sh_degree']}" for row in rows]
    bottom = [0.0] * len(rows)
    for phase in PHASES:
        values = [row["phases_ms"][phase] for row in rows]
        axis.bar(labels, values, 0.6, bottom=bottom, label=phase)
        bottom = [b + v for b, v in zip(bottom, values, strict=True)]
    peers = [row["peer_ms"] or math.nan for row in rows]
    axis.plot(labels, peers, "k_", markersize=24, label="OpenSplat bd0400d (CPU)")
    axis.set(yscale="log", ylabel=f"ms per iteration, {most} threads", xlabel="Gaussians", ylim=(1, None))
    axis.grid(axis="y", alpha=0.3)
    figure.legend(loc="outside upper center", ncols=len(PHASES) + 1)
    figure.savefig(FILE.with_suffix(".png"), dpi=120)


def main(scene: Path = SCENES / "fern", quick: bool = False, iterations: int = 15, only: int | None = None) -> None:
    """Measure the training iteration.

    Args:
        scene: The folder of "fern".
        quick: Two sizes only, SH degree 3, all cores.
        iterations: Timed iterations per row.
        only: Number of Gaussians. Only its rows are measured; the others stay as measured before.
    """
    about = provenance() | {"iterations": iterations, "quick": quick}
    print(f"{about['cpu']}, {about['cores']} cores, commit {about['commit']}")
    print(f"{'Gaussians':>9} {'SH':>2} {'threads':>7} {'ms':>7}  " + " ".join(f"{p:>9}" for p in PHASES), end="")
    print(f" {'peer':>6} {'faster':>6}")
    fern = load_scene(scene)
    rows = []
    for count in sorted({usable_cores()} if quick else {1, usable_cores()}, reverse=True):
        for sh_degree in (3,) if quick else (0, 3):
            for n in (1_000, 10_000) if quick else (*PEER, *LARGE):
                if only not in (None, n):
                    continue
                with threads(count):
                    row: dict[str, Any] = {"gaussians": n, "sh_degree": sh_degree, "threads": count}
                    row |= measure(resampled(fern, n), sh_degree, iterations)
                comparable = (count, sh_degree) == (PEER_THREADS, PEER_SH_DEGREE)
                peer = row["peer_ms"] = PEER.get(n) if comparable else None
                rows.append(row)
                print(
                    f"{n:9,} {sh_degree:2} {count:7} {row['ms']:7.1f}  "
                    + " ".join(f"{row['phases_ms'][p]:9.2f}" for p in PHASES)
                    + (f" {peer:6} {peer / row['ms']:5.1f}x" if peer else ""),
                    flush=True,
                )
            if only is not None:
                continue
            series = [r for r in rows if r["threads"] == count and r["sh_degree"] == sh_degree]
            growth = exponents([r["gaussians"] for r in series], [r["ms"] for r in series])
            print(f"  grows with Gaussians^{growth['fitted']:.2f}, at most ^{growth['steepest']:.2f}")
    if only is not None:
        rows += [r for r in json.loads(FILE.read_text())["fern"]["rows"] if r["gaussians"] != only]
        rows.sort(key=lambda r: (-r["threads"], r["sh_degree"], r["gaussians"]))
    write_part(FILE, "fern", rows, about)
    plot(rows)


if __name__ == "__main__":
    tyro.cli(main)
