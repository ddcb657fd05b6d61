"""Speed of the CPU rasterizer: forward and backward pass, scaling, growth, memory, optimizations, and the fused loss.

    python benchmarks/raster.py                        # everything, about five minutes on two cores
    python benchmarks/raster.py --parts scenes --quick
    python benchmarks/raster.py --parts gaussians --only 3000000    # one row; the others stay as measured before

A pass is `rasterization`, a mean-L1 loss, and the backward pass to means, scales, quats, opacities and colours. Times
are medians over repeats with new inputs, after two warm-up passes. Each part prints a table and replaces its entry in
`benchmarks/results/raster.json`. The plot `raster.png` shows all parts measured so far. The garden is read from
`$SKIPGS_SHARED/data/garden_points.npz` (gsplat's test asset; default `../shared`). Run it on an idle machine.
"""

from __future__ import annotations

import contextlib
import ctypes
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, get_args

import torch
import tyro
from common import (
    PARAMETERS,
    RESULTS,
    exponents,
    frustum_scene,
    garden_scene,
    kernel_seconds,
    leaves,
    median_ms,
    multiply_adds_per_second,
    provenance,
    relative_difference,
    threads,
    write_part,
)
from pairs import blended_pairs
from raster_loss import part_loss
from raster_plot import plot
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.fallback_raster.runtime.optimizations import OPTIMIZATIONS, without_optimizations
from skipgs_plug.fallback_raster.splats import rasterize_splats
from skipgs_plug.trainer.row_order import morton_order
from skipgs_plug.trainer.scalars import peak_memory

FILE = RESULTS / "raster.json"
Part = Literal["scenes", "threads", "gaussians", "pixels", "sh_terms", "order", "optimizations", "loss"]

# Milliseconds of OpenSplat bd0400d's CPU rasterizer on one and on two cores of an AMD EPYC (Zen 5) for these scenes,
# projection, forward, mean-L1 and backward; medians of 18 passes, three rounds. See docs/how_it_works/rasterizer.md.
PEER = {
    ("random", 1_000, "128x128"): (24, 21),
    ("random", 1_000, "256x256"): (94, 60),
    ("random", 1_000, "504x378"): (294, 168),
    ("random", 10_000, "128x128"): (51, 38),
    ("random", 10_000, "256x256"): (181, 112),
    ("random", 10_000, "504x378"): (558, 292),
    ("random", 50_000, "128x128"): (102, 68),
    ("random", 50_000, "256x256"): (256, 161),
    ("random", 50_000, "504x378"): (656, 362),
    ("garden", 138_766, "162x105"): (199, 135),
    ("garden", 138_766, "324x210"): (320, 211),
    ("garden", 138_766, "648x420"): (841, 508),
}
GARDEN_DOWNSCALE = {"162x105": 4, "324x210": 2, "648x420": 1}

# Multiply-adds that each blended pair needs at least. Forward: quadratic form 2, exp 5, transmittance 2, weight 1,
# colour 3. Backward: quadratic form and exp again 7, transmittance 3, colour behind and v_alpha 6, weight, v_sigma and
# behind 3, gradient of the colour 3, moments 3.
MULTIPLY_ADDS_PER_PAIR = 13 + 25

PROCESSES = 3  # processes for each point of a growth series

PHASES = {
    "project": ("project_forward", "list_visible", "sh_forward"),
    "bin": ("pack_and_count", "scan_pairs", "fill_pairs"),
    "sort and blend": ("blend_forward_3",),
    "blend backward": ("blend_adjoint_3", "reduce_pairs"),
    "project backward": ("project_adjoint", "sh_adjoint"),
}


def one_pass(scene: dict[str, Any], seed: int, loss_columns: slice = slice(None)) -> tuple[float, float, Any]:
    """Return seconds of the forward pass with the loss, seconds of the backward pass, and the inputs with gradients."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(1, scene["height"], scene["width"], 3, generator=generator)
    inputs = leaves(scene, PARAMETERS)
    start = time.perf_counter()
    image, _, _ = rasterization(**inputs, packed=False)
    loss = (image - target)[:, :, loss_columns].abs().mean()
    middle = time.perf_counter()
    loss.backward()
    return middle - start, time.perf_counter() - middle, {**inputs, "image": image.detach()}


def measure(make: Callable[[int], dict[str, Any]], repeats: int) -> dict[str, Any]:
    """Return medians over passes with new inputs, without the first two passes."""
    forward, backward, whole = [], [], []
    phases: dict[str, list[float]] = {name: [] for name in (*PHASES, "other")}
    for seed in range(repeats + 2):
        scene = make(seed)
        with kernel_seconds() as kernels:
            there, back, _ = one_pass(scene, seed)
        forward.append(there)
        backward.append(back)
        whole.append(there + back)
        for name, members in PHASES.items():
            phases[name].append(sum(kernels.get(member, 0.0) for member in members))
        phases["other"].append(there + back - sum(kernels.values()))
    return {
        "ms": median_ms(whole[2:]),
        "ms_min": 1000 * min(whole[2:]),
        "forward_ms": median_ms(forward[2:]),
        "backward_ms": median_ms(backward[2:]),
        "phases_ms": {name: median_ms(values[2:]) for name, values in phases.items()},
    }


def scene_maker(kind: str, n: int, size: str, sh_degree: int | None = None) -> Callable[[int], dict[str, Any]]:
    """Return a function from a seed to a scene of a kind ("random" or "garden") and image size."""
    if kind == "garden":
        return lambda seed: garden_scene(GARDEN_DOWNSCALE[size], seed, sh_degree)
    width, height = map(int, size.split("x"))
    return lambda seed: frustum_scene(n, width, height, seed, sh_degree)


def part_scenes(quick: bool, repeats: int, only: str | None) -> list[dict[str, Any]]:
    """Measure the scenes for which a peer was timed, on all cores and on one."""
    counts = sorted({1, usable_cores()}, reverse=True)
    peaks = {}
    for count in counts:
        with threads(count):
            peaks[count] = multiply_adds_per_second()
    print("measured peak, 10^9 multiply-adds/s: ", {count: round(peak / 1e9, 1) for count, peak in peaks.items()})
    print(
        f"{'scene':>22} {'pairs':>8} {'threads':>7} {'ms':>7} {'fwd':>6} {'bwd':>6} {'M pairs/s':>9} {'peak':>5}",
        end="",
    )
    print(f" {'peer':>6} {'faster':>6}  phases (ms)")
    rows = []
    for (kind, n, size), peer in PEER.items():
        if (quick and size not in ("504x378", "324x210")) or only not in (None, f"{kind},{n},{size}"):
            continue
        make = scene_maker(kind, n, size)
        pairs = blended_pairs(make(0))
        for count in counts:
            with threads(count):
                row: dict[str, Any] = {"kind": kind, "gaussians": n, "size": size, "pairs": pairs, "threads": count}
                row |= measure(make, repeats)
            seconds = row["ms"] / 1000
            row["pairs_per_second"] = pairs / seconds
            row["share_of_peak"] = pairs * MULTIPLY_ADDS_PER_PAIR / seconds / peaks[count]
            row["peak_multiply_adds_per_second"] = peaks[count]
            row["peer_ms"] = peer[count - 1] if count <= len(peer) else None
            rows.append(row)
            print(
                f"{kind:>7} {n:>7,} {size:>7} {pairs / 1e6:7.2f}M {count:7} {row['ms']:7.1f} {row['forward_ms']:6.1f} "
                f"{row['backward_ms']:6.1f} {row['pairs_per_second'] / 1e6:9.0f} {row['share_of_peak']:5.0%} "
                + (f"{row['peer_ms']:6} {row['peer_ms'] / row['ms']:5.1f}x  " if row["peer_ms"] else " " * 15)
                + ", ".join(f"{name} {ms:.1f}" for name, ms in row["phases_ms"].items()),
                flush=True,
            )
    if only is not None:
        measured = {",".join(map(str, key)): key for key in PEER}[only]
        before = json.loads(FILE.read_text())["scenes"]["rows"]
        rows += [row for row in before if (row["kind"], row["gaussians"], row["size"]) != measured]
        rows.sort(key=lambda row: list(PEER).index((row["kind"], row["gaussians"], row["size"])))
    return rows


def part_threads(quick: bool, repeats: int, only: str | None) -> list[dict[str, Any]]:
    """Measure the speedup of one scene by the number of threads."""
    make = scene_maker("random", 10_000 if quick else 50_000, "504x378")
    rows: list[dict[str, Any]] = []
    for count in sorted({1, usable_cores(), *(2**k for k in range(usable_cores().bit_length()))}):
        with threads(count):
            rows.append({"threads": count, **measure(make, repeats)})
        speedup = rows[0]["ms"] / rows[-1]["ms"]
        rows[-1]["speedup"] = speedup
        print(f"{count:3} threads {rows[-1]['ms']:8.1f} ms  {speedup:.2f}x", flush=True)
    return rows


def part_gaussians(quick: bool, repeats: int, only: str | None) -> dict[str, Any]:
    """Measure time and memory of 1,000 to 3,000,000 Gaussians on 504x378 pixels."""
    counts = (1_000, 10_000, 100_000)
    if not quick:
        counts += (3_000, 30_000, 300_000, 1_000_000, 3_000_000)
    return growth("gaussians", {n: (n, "504x378", None) for n in sorted(counts)}, repeats, only)


def part_pixels(quick: bool, repeats: int, only: str | None) -> dict[str, Any]:
    """Measure time and memory of 10,000 Gaussians on 128x128 to 1920x1080 pixels."""
    sizes = ((128, 128), (256, 256), (504, 378), (1008, 756), (1920, 1080))[: 3 if quick else 5]
    return growth("pixels", {w * h: (10_000, f"{w}x{h}", None) for w, h in sizes}, repeats, only)


def part_sh_terms(quick: bool, repeats: int, only: str | None) -> dict[str, Any]:
    """Measure time and memory of SH degree 0 to 3 with 100,000 Gaussians on 504x378 pixels."""
    n = 10_000 if quick else 100_000
    points = {(degree + 1) ** 2: (n, "504x378", degree) for degree in range(4)}
    return growth("sh_terms", points, repeats, only)


def growth(part: str, points: dict[int, tuple[int, str, int | None]], repeats: int, only: str | None) -> dict[str, Any]:
    """Measure each point in processes of its own, because the peak memory of a process never falls.

    The peak differs by a seventh between processes, depending on the state of the system's allocator. Of `PROCESSES`
    processes the median peak and the fastest median time count.

    `only` names the one point to measure. The other points stay as measured before.
    """
    rows = []
    if only is not None:
        rows = [row for row in json.loads(FILE.read_text())[part]["rows"]["points"] if row["x"] != int(only)]
        points = {int(only): points[int(only)]}
    for x, point in points.items():
        command = [sys.executable, __file__, "--point", json.dumps(point), "--repeats", str(repeats)]
        outputs = [
            subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout for _ in range(PROCESSES)
        ]
        found = [json.loads(output.splitlines()[-1]) for output in outputs]
        peaks = sorted(one["peak_mib"] for one in found)
        rows.append(
            {"x": x, **min(found, key=lambda one: one["ms"]), "peak_mib": peaks[PROCESSES // 2], "peaks": peaks}
        )
        print(f"{x:>9,} {rows[-1]['ms']:8.1f} ms {rows[-1]['peak_mib']:7.1f} MiB above start", flush=True)
    rows.sort(key=lambda row: row["x"])
    measures = {
        "time": [row["ms"] for row in rows],
        "memory": [max(row["peak_mib"], 1.0) for row in rows],
    }
    growing = {name: exponents([row["x"] for row in rows], values) for name, values in measures.items()}
    for name, exponent in growing.items():
        print(f"{name:>9} grows with exponent {exponent['fitted']:.2f}, at most {exponent['steepest']:.2f}")
    return {"points": rows, "exponents": growing}


def measure_point(point: str, repeats: int) -> None:
    """Measure one point of `growth`, and print time and memory as JSON."""
    n, size, sh_degree = json.loads(point)
    one_pass(frustum_scene(10, 32, 32, 0, sh_degree), 0)  # loads all kernels, and compiles them on first use
    if sys.platform == "linux":
        # Loading or compiling kernels may take more memory than rendering: free it, and reset the peak.
        with contextlib.suppress(AttributeError):  # no malloc_trim without glibc
            ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")
    before = peak_memory(torch.device("cpu")) or 0
    with threads(usable_cores()):
        result = measure(scene_maker("random", n, size, sh_degree), repeats)
    peak = peak_memory(torch.device("cpu")) or 0
    print(json.dumps({**result, "peak_mib": (peak - before) / 2**20}))


def standard_error(values: list[float]) -> float:
    """Return the standard error of the median, assuming normally distributed values with outliers."""
    first, _, third = statistics.quantiles(values, n=4)
    return 1.253 * (third - first) / 1.349 / math.sqrt(len(values))


def part_order(quick: bool, repeats: int, only: str | None) -> list[dict[str, Any]]:
    """Measure how the order of rows affects time at SH degree 3, where a camera sees part of a scene."""
    size = "324x210" if quick else "162x105"
    scene = garden_scene(GARDEN_DOWNSCALE[size], 0, sh_degree=3)
    n = len(scene["means"])
    orders = {
        "file": torch.arange(n),
        "shuffled": torch.randperm(n, generator=torch.Generator().manual_seed(0)),
        "space": morton_order(scene["means"]),
    }
    scenes = {name: {**scene, **{key: scene[key][order] for key in PARAMETERS}} for name, order in orders.items()}
    times: dict[tuple[str, str], list[float]] = {}
    images: dict[tuple[str, str], Tensor] = {}
    with threads(usable_cores()):
        for seed in range(repeats + 2):  # passes alternate between orders
            for name, ordered in scenes.items():
                there, back, fast = one_pass(ordered, seed)
                times.setdefault((name, "activated"), []).append(there + back)
                images[name, "activated"] = fast["image"][0]
                seconds, images[name, "raw"] = raw_pass(ordered, seed)
                times.setdefault((name, "raw"), []).append(seconds)
    rows = []
    for (name, parameters), seconds in times.items():
        error = (images[name, parameters] - images["file", "activated"]).abs().max().item()
        rows.append({"order": name, "parameters": parameters, "ms": median_ms(seconds[2:]), "image_difference": error})
        print(f"{name:>9} {parameters:>9} {rows[-1]['ms']:7.1f} ms  image differs by {error:.1e}", flush=True)
    return rows


def raw_pass(scene: dict[str, Any], seed: int) -> tuple[float, Tensor]:
    """Return seconds of forward and backward pass with raw parameters, and the image."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(scene["height"], scene["width"], 3, generator=generator)
    raw = [scene["means"], scene["quats"], scene["scales"].log(), scene["opacities"].logit()]
    raw += [scene["colors"][:, :1].contiguous(), scene["colors"][:, 1:].contiguous()]
    raw = [tensor.clone().requires_grad_() for tensor in raw]
    start = time.perf_counter()
    camera = (scene["viewmats"][0], scene["Ks"][0], scene["width"], scene["height"], scene["sh_degree"])
    image, _, _ = rasterize_splats(*raw, *camera)
    (image - target).abs().mean().backward()
    return time.perf_counter() - start, image.detach()


def part_optimizations(quick: bool, repeats: int, only: str | None) -> list[dict[str, Any]]:
    """Measure the time with and without each optimization, alternately, and by how much it changes the result."""
    scene = garden_scene(GARDEN_DOWNSCALE["324x210" if quick else "648x420"], 0, sh_degree=3)
    left = slice(0, scene["width"] // 2)  # half of the image has no gradient
    names: list[tuple[str, ...]] = [(name,) for name in OPTIMIZATIONS] + [tuple(OPTIMIZATIONS)]
    rows = []
    print(f"{'left out':>18} {'ms':>7} {'ms with':>7} {'saves':>14} {'image':>8} {'gradient':>8}")
    for left_out in names:
        # A pass affects the next one through caches and free memory, so the order changes in every round.
        seconds: dict[bool, list[float]] = {True: [], False: []}
        inputs = {}
        for seed in range(4 * repeats + 2):
            for shortened in (True, False) if seed % 2 else (False, True):
                with contextlib.nullcontext() if shortened else without_optimizations(*left_out):
                    there, back, inputs[shortened] = one_pass(scene, seed, left)
                if seed >= 2:
                    seconds[shortened].append(there + back)
        fast, slow = inputs[True], inputs[False]
        ratios = [one / other for one, other in zip(seconds[True], seconds[False], strict=True)]
        row = {
            "optimization": left_out[0] if len(left_out) == 1 else "all",
            "ms": median_ms(seconds[True]),
            "ms_without": median_ms(seconds[False]),
            # Ratios of neighbouring passes, between which the machine hardly changes.
            "saved": 1 - statistics.median(ratios),
            "saved_error": standard_error(ratios),
            "image_difference": (fast["image"] - slow["image"]).abs().max().item(),
            "gradient_difference": max(relative_difference(fast[p].grad, slow[p].grad) for p in PARAMETERS),
        }
        rows.append(row)
        print(
            f"{row['optimization']:>18} {row['ms_without']:7.1f} {row['ms']:7.1f} "
            f"{row['saved']:6.1%} +- {row['saved_error']:.1%} "
            f"{row['image_difference']:8.1e} {row['gradient_difference']:8.1e}",
            flush=True,
        )
    return rows


PARTS: dict[str, Callable[[bool, int, str | None], Any]] = {
    "scenes": part_scenes,
    "threads": part_threads,
    "gaussians": part_gaussians,
    "pixels": part_pixels,
    "sh_terms": part_sh_terms,
    "order": part_order,
    "optimizations": part_optimizations,
    "loss": part_loss,
}


def main(
    parts: tuple[Part, ...] = get_args(Part),
    quick: bool = False,
    repeats: int = 7,
    only: str | None = None,
    point: str | None = None,
) -> None:
    """Measure the rasterizer.

    Args:
        parts: Tables to measure.
        quick: Measure fewer and smaller scenes.
        repeats: Timed passes per row.
        only: One row of a part to measure; the others stay as measured before. A scene ("garden,138766,162x105"), or
            the number of Gaussians, pixels or terms of a growth series.
        point: For the benchmark's own use: one point of a growth series, as JSON.
    """
    if point is not None:
        measure_point(point, repeats)
        return
    for part in parts:
        about = provenance() | {"repeats": repeats, "quick": quick}
        print(f"\n{part}: {about['cpu']}, {about['cores']} cores, commit {about['commit']}")
        plot(write_part(FILE, part, PARTS[part](quick, repeats, only), about), FILE.with_suffix(".png"))


if __name__ == "__main__":
    tyro.cli(main)
