"""Shared by the benchmarks: scenes, clocks, errors, provenance, result files."""

import functools
import json
import os
import shlex
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.bench.provenance import commit, cpu_name, versions
from skipgs_plug.fallback_raster import get_num_threads, set_num_threads
from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.fallback_raster.runtime.launch import Worker, worker
from skipgs_plug.fallback_raster.runtime.parameters import FloatOutput
from skipgs_plug.trainer.files import write_aside

RESULTS = Path(__file__).parent / "results"
# Tensors that a pass differentiates.
PARAMETERS = ("means", "scales", "quats", "opacities", "colors")
SCENES = Path(os.environ.get("SKIPGS_SHARED", Path(__file__).parents[2] / "shared")) / "data"


def frustum_scene(n: int, width: int, height: int, seed: int = 0, sh_degree: int | None = None) -> dict[str, Any]:
    """Return N Gaussians in the view frustum between depth 2 and 6. Each pixel blends 40 to 70 of them.

    Their size is proportional to N^(-1/3), so the number of blended pairs hardly depends on N.
    """
    rng = np.random.default_rng(seed)
    focal = 0.9 * width
    half_x, half_y = 0.55 * width / focal, 0.55 * height / focal  # tangents; 10 % more than the image
    depth = rng.uniform(2, 6, n)
    room = 4 * half_x * half_y * (6**3 - 2**3) / 3
    means = np.stack([rng.uniform(-half_x, half_x, n) * depth, rng.uniform(-half_y, half_y, n) * depth, depth], 1)
    scales = 0.5 * np.cbrt(room / n) * rng.uniform(0.3, 1, (n, 3))
    quats = rng.normal(size=(n, 4))
    opacities = 1 / (1 + np.exp(-rng.normal(0, 1.5, n)))
    colors = rng.uniform(0, 1, (n, 3)) if sh_degree is None else _sh(rng, n, sh_degree)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    return _scene(means, quats, scales, opacities, colors, np.eye(4), np.array(K), width, height, sh_degree)


def garden_scene(downscale: int, seed: int = 0, sh_degree: int | None = None) -> dict[str, Any]:
    """Return the 138,766 SfM points of Mip-NeRF 360 "garden" as round Gaussians, with its first camera.

    The seed moves each point by about a hundredth of the distance to its neighbours.
    """
    rng = np.random.default_rng(seed)
    data, spacing = _garden()
    n = len(spacing)
    means = data["means3d"] + 0.01 * spacing * rng.normal(size=(n, 3))
    width, height = int(data["width"]) // downscale, int(data["height"]) // downscale
    K = data["Ks"][0] * np.array([[width / data["width"]], [height / data["height"]], [1.0]])
    quats = np.tile([1.0, 0, 0, 0], (n, 1))
    colors = data["colors"] / 255 if sh_degree is None else _sh(rng, n, sh_degree)
    scales, opacities = np.repeat(spacing, 3, 1), np.full(n, 0.5)
    return _scene(means, quats, scales, opacities, colors, data["viewmats"][0], K, width, height, sh_degree)


@functools.cache
def _garden() -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Return the arrays of the file, and the mean distance of each point to its three nearest neighbours [N, 1]."""
    from scipy.spatial import cKDTree

    with np.load(SCENES / "garden_points.npz") as file:
        data = dict(file)
    points = data["means3d"].astype(np.float64)
    return data, np.maximum(cKDTree(points).query(points, k=4)[0][:, 1:].mean(1, keepdims=True), 1e-7)


def _sh(rng: np.random.Generator, n: int, degree: int) -> np.ndarray:
    return 0.3 * rng.normal(size=(n, (degree + 1) ** 2, 3))


def _scene(
    means: np.ndarray,
    quats: np.ndarray,
    scales: np.ndarray,
    opacities: np.ndarray,
    colors: np.ndarray,
    viewmat: np.ndarray,
    K: np.ndarray,
    width: int,
    height: int,
    sh_degree: int | None,
) -> dict[str, Any]:
    arrays = {"means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": colors}
    arrays |= {"viewmats": viewmat[None], "Ks": K[None]}
    tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
    return {**tensors, "width": width, "height": height, "sh_degree": sh_degree}


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Run the rasterizer on `count` threads inside the `with` statement, and torch on one, as the trainer does.

    Idle threads of torch would spin and slow down those of the rasterizer.
    """
    before = get_num_threads(), torch.get_num_threads()
    set_num_threads(count)
    torch.set_num_threads(1)
    try:
        yield
    finally:
        set_num_threads(before[0])
        torch.set_num_threads(before[1])


@contextmanager
def kernel_seconds() -> Iterator[dict[str, float]]:
    """Collect the wall time of the rasterizer's kernels by name inside the `with` statement."""
    seconds: dict[str, float] = {}
    original = Worker.__call__

    def timed(self: Worker[Any], *arguments: Any, **named: Any) -> None:
        start = time.perf_counter()
        original(self, *arguments, **named)
        seconds[self.name] = seconds.get(self.name, 0.0) + time.perf_counter() - start

    Worker.__call__ = timed  # type: ignore[method-assign]
    try:
        yield seconds
    finally:
        Worker.__call__ = original  # type: ignore[method-assign]


# Ten independent chains hide the latency of a multiply-add. The pragma makes each one instruction.
@worker(
    """
for (int item = first; item < last; ++item) {
#pragma clang fp contract(fast)
    v16 a[10];
    for (int j = 0; j < 10; ++j) a[j] = lane + (float)j;
    for (int i = 0; i < rounds; ++i)
        for (int j = 0; j < 10; ++j) a[j] = a[j] * factor + 1.0f;
    for (int j = 1; j < 10; ++j) a[0] += a[j];
    out[item] = sum(a[0]);
}
""",
    items="items",
    grain=1,
)
def multiply_add(out: FloatOutput, factor: float, rounds: int, items: int) -> None: ...


def multiply_adds_per_second() -> float:
    """Measure the peak of float32 multiply-adds on the threads in use: the best of 7 runs."""
    items, rounds = 64, 100_000
    out = torch.empty(items)
    best = min(clock(lambda: multiply_add(out, 0.999, rounds, items)) for _ in range(7))
    return items * rounds * 10 * 16 / best


def clock(work: Callable[[], Any]) -> float:
    """Return the seconds that `work` takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def median_ms(seconds: Sequence[float]) -> float:
    return 1000 * statistics.median(seconds)


def exponents(sizes: Sequence[float], values: Sequence[float]) -> dict[str, float]:
    """Return how `values` grow with `sizes`: the least-squares exponent, and the largest between two neighbours."""
    x, y = np.log(np.asarray(sizes, float)), np.log(np.asarray(values, float))
    return {"fitted": float(np.polyfit(x, y, 1)[0]), "steepest": float((np.diff(y) / np.diff(x)).max())}


def relative_difference(value: Tensor, truth: Tensor) -> float:
    """Return the L2 distance relative to the L2 norm of the truth."""
    return ((value.double() - truth.double()).norm() / truth.double().norm().clamp(min=1e-300)).item()


def provenance() -> dict[str, Any]:
    """Return the conditions that a reader needs to repeat the measurement or to doubt it."""
    return {
        "command": shlex.join(["python", *sys.argv]),
        "commit": commit(),
        "cpu": cpu_name(),
        "cores": usable_cores(),
        "load_before": os.getloadavg()[0],  # above 0.5 other programs were running, and times are unreliable
        "versions": versions(),
    }


def write_part(path: Path, part: str, rows: Any, about: dict[str, Any]) -> dict[str, Any]:
    """Replace one part of a result file and return the whole. Other parts keep their own provenance."""
    whole = json.loads(path.read_text()) if path.exists() else {}
    whole[part] = {"about": about, "rows": rows}
    write_results(path, whole)
    return whole


def write_results(path: Path, content: Any) -> None:
    with write_aside(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n")


def leaves(scene: dict[str, Any], names: Sequence[str]) -> dict[str, Any]:
    """Return a copy of the scene in which the named tensors require gradients."""
    copy = {k: v.clone() if isinstance(v, Tensor) else v for k, v in scene.items()}
    for name in names:
        copy[name].requires_grad_()
    return copy
