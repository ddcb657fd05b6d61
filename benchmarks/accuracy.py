"""Run time against error of the CPU rasterizer: float32 results beside the float64 reference.

    python benchmarks/accuracy.py [--garden garden_points.npz] [--repeats 5]

Prints a table and writes it to `benchmarks/results/accuracy.json`. Time is one forward and backward pass, the
median of the repeats after one warm-up. Image and alpha errors are the greatest absolute difference (depth: as a
share of the greatest depth), gradient errors are relative L2. Pixels within 0.01 % of a cut-off (1/255, 0.999,
transmittance 1e-4), or with two Gaussians at one depth, are left out, since rounding decides there on a jump: the
column "left out" is their share. A last block compares the reference itself with gsplat's PyTorch functions, both
in float64.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import tyro
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.launch import get_num_threads
from skipgs_plug.fallback_raster.torch_reference import near_cutoff, rasterization_reference
from skipgs_plug.fallback_raster.torch_reference_projection import rotation_matrices, spherical_harmonics

RESULTS = Path(__file__).parent / "results" / "accuracy.json"
PARAMETERS = ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats")
IMAGE_LIMIT, GRADIENT_LIMIT = 1e-5, 1e-4
BAND = 1e-4  # distance to a cut-off, as a share of it, below which a pixel is left out


def frustum_scene(n: int, width: int, height: int, sh_degree: int | None = None) -> dict[str, Any]:
    """Gaussians that fill the view frustum between depth 2 and 6, 40 to 70 blended per pixel."""
    generator = torch.Generator().manual_seed(0)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    focal = 0.9 * width
    tan = torch.tensor([width, height], dtype=torch.float64) / (2 * focal) * 1.1
    depth = uniform(2, 6, n)
    volume = (4 * tan.prod() * (6**3 - 2**3) / 3).item()
    return _float32(
        means=torch.cat([uniform(-1, 1, n, 2) * tan * depth[:, None], depth[:, None]], dim=1),
        scales=0.5 * (volume / n) ** (1 / 3) * uniform(0.3, 1, n, 3),
        quats=normal(n, 4),
        opacities=torch.sigmoid(1.5 * normal(n)),
        colors=uniform(0, 1, n, 3) if sh_degree is None else 0.3 * normal(n, (sh_degree + 1) ** 2, 3),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])[None],
        backgrounds=uniform(0, 1, 1, 3),
        width=width,
        height=height,
        sh_degree=sh_degree,
    )


def garden_scene(path: Path, downscale: int) -> dict[str, Any]:
    """The SfM points of Mip-NeRF 360 'garden' (gsplat's test asset), about as wide as their neighbours are far."""
    from scipy.spatial import cKDTree

    data = np.load(path)
    means = torch.from_numpy(data["means3d"])
    distance = torch.from_numpy(cKDTree(means).query(means, k=4)[0])[:, 1:].mean(dim=1).clamp(min=1e-7)
    generator = torch.Generator().manual_seed(0)
    widths = 0.5 + torch.rand(len(means), 3, generator=generator)  # no axis alike, so that rotations matter
    Ks = torch.from_numpy(data["Ks"][:1]).double()
    width, height = int(data["width"]) // downscale, int(data["height"]) // downscale
    Ks[:, 0] *= width / int(data["width"])
    Ks[:, 1] *= height / int(data["height"])
    return _float32(
        means=means,
        scales=distance[:, None] * widths,
        quats=torch.randn(len(means), 4, generator=generator),
        opacities=torch.full((len(means),), 0.5),
        colors=torch.from_numpy(data["colors"]) / 255,
        viewmats=torch.from_numpy(data["viewmats"][:1]),
        Ks=Ks,
        backgrounds=torch.zeros(1, 3),
        width=width,
        height=height,
        sh_degree=None,
    )


def _float32(**scene: Any) -> dict[str, Any]:
    return {k: v.float().contiguous() if torch.is_tensor(v) else v for k, v in scene.items()}


class Pass(NamedTuple):
    """One forward and backward pass."""

    values: dict[str, Tensor]  # image, alpha, and the gradients by name
    keep: Tensor  # [C, H, W, 1] pixels that count
    seconds: float


def run(
    function: Callable[..., Any],
    scene: dict[str, Any],
    dtype: torch.dtype,
    keep: Tensor | None = None,
    **options: Any,
) -> Pass:
    """Render and go back from a random gradient of the pixels in `keep` (found here if None)."""
    inputs = dict(scene)
    for name, value in scene.items():
        if torch.is_tensor(value):
            inputs[name] = value.to(dtype, copy=True).requires_grad_(name in PARAMETERS)
    start = time.perf_counter()
    image, alpha, info = function(**inputs, packed=False, **options)
    seconds = time.perf_counter() - start
    if keep is None:
        keep = ~near_cutoff(info, relative=BAND)[..., None]
    generator = torch.Generator().manual_seed(1)
    upstream = [
        (torch.randn(t.shape, generator=generator, dtype=torch.float64) * keep).to(dtype) for t in (image, alpha)
    ]
    info["means2d"].retain_grad()
    start = time.perf_counter()
    torch.autograd.backward([image, alpha], upstream)
    seconds += time.perf_counter() - start
    values = {"image": image.detach() * keep, "alpha": alpha.detach() * keep, "means2d": info["means2d"].grad}
    if options.get("absgrad"):
        values["absgrad"] = info["means2d"].absgrad
    for name in PARAMETERS:  # colors and backgrounds have none in a picture of depths
        if inputs[name].grad is not None and inputs[name].grad.any():
            values[name] = inputs[name].grad
    return Pass(values, keep, seconds)


def relative_error(value: Tensor, truth: Tensor) -> float:
    """L2 distance as a share of the truth's L2 norm."""
    return ((value.double() - truth.double()).norm() / truth.double().norm().clamp(min=1e-300)).item()


def measure(name: str, scene: dict[str, Any], repeats: int, **options: Any) -> dict[str, Any]:
    """One row of the table."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the reference's many small operations only wait for each other on more
    reference = run(rasterization_reference, scene, torch.float64, **options)
    torch.set_num_threads(threads)
    passes = [run(rasterization, scene, torch.float32, reference.keep, **options) for _ in range(repeats + 1)]
    truth, value = reference.values, passes[-1].values
    greatest = max(1.0, truth["image"].abs().max().item())
    return {
        "case": name,
        "gaussians": len(scene["means"]),
        "image": f"{scene['width']}x{scene['height']}",
        "milliseconds": 1000 * statistics.median(p.seconds for p in passes[1:]),
        "left_out": 1 - reference.keep.double().mean().item(),
        "image_error": (value["image"] - truth["image"]).abs().max().item() / greatest,
        "alpha_error": (value["alpha"] - truth["alpha"]).abs().max().item(),
        "gradient_errors": {k: relative_error(value[k], truth[k]) for k in truth if k not in ("image", "alpha")},
    }


def against_gsplat() -> dict[str, float]:
    """Relative L2 differences between the reference and gsplat's `_torch_impl`, values and gradients."""
    from gsplat.cuda import _torch_impl as theirs

    generator = torch.Generator().manual_seed(0)
    scene = frustum_scene(2000, 128, 96)
    scene["opacities"] = torch.ones_like(scene["opacities"])
    differences = {}
    for degree in range(4):
        directions = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
        coeffs = torch.randn(1000, 16, 3, generator=generator, dtype=torch.float64)
        truth = theirs._spherical_harmonics(degree, directions, coeffs)
        differences[f"SH degree {degree}"] = relative_error(spherical_harmonics(degree, directions, coeffs), truth)
    results = []
    for ours in (True, False):
        names = ("means", "quats", "scales", "viewmats")
        inputs = dict(scene) | {name: scene[name].double().requires_grad_() for name in names}
        inputs |= {name: scene[name].double() for name in ("opacities", "colors", "Ks", "backgrounds")}
        if ours:
            *_, info = rasterization_reference(**inputs, packed=False, rasterize_mode="antialiased")
            seen = (info["radii"] > 0).all(dim=-1)
            rows = {name: info[name][seen] for name in ("means2d", "depths", "conics")}
            rows["compensation"] = info["opacities"][seen]
            axes = rotation_matrices(inputs["quats"]) * inputs["scales"][:, None, :]
            rows["covariance"] = axes @ axes.transpose(-1, -2)
        else:
            covariance, _ = theirs._quat_scale_to_covar_preci(inputs["quats"], inputs["scales"], True, False)
            camera = inputs["viewmats"], inputs["Ks"], inputs["width"], inputs["height"]
            _, *projected = theirs._fully_fused_projection(
                inputs["means"], covariance, *camera, calc_compensations=True
            )
            rows = {k: v[seen] for k, v in zip(("means2d", "depths", "conics", "compensation"), projected, strict=True)}
            rows["covariance"] = covariance
        sum(row.square().sum() for row in rows.values()).backward()
        results.append(rows | {f"gradient of {name}": inputs[name].grad for name in names})
    return differences | {name: relative_error(results[0][name], results[1][name]) for name in results[1]}


def provenance() -> dict[str, Any]:
    """What a reader needs to repeat or to doubt the figures."""
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"], capture_output=True, text=True, cwd=Path(__file__).parent
    )
    cpu = platform.processor() or platform.machine()
    if Path("/proc/cpuinfo").exists():
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next((line.split(":")[1].strip() for line in lines if line.startswith("model name")), cpu)
    return {
        "command": shlex.join(["python", *sys.argv]),
        "commit": commit.stdout.strip(),
        "cpu": cpu,
        "cores": os.cpu_count(),
        "load_average": os.getloadavg()[0],  # times hold only if this was near the threads in use
        "threads": get_num_threads(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in ("torch", "warp-lang", "gsplat")},
    }


def main(garden: Path | None = None, repeats: int = 5) -> None:
    """Measure all cases.

    Args:
        garden: `garden_points.npz` of gsplat's tests; without it the garden rows are left out.
        repeats: Timed passes of each case.
    """
    small = {degree: frustum_scene(2000, 128, 96, degree) for degree in (None, 0, 1, 2, 3)}
    cases: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
        ("plain colors", small[None], {}),
        *((f"SH {degree}", small[degree], {}) for degree in range(4)),
        ("antialiased, SH 3", small[3], {"rasterize_mode": "antialiased"}),
        *((mode, small[None], {"render_mode": mode}) for mode in ("D", "ED", "RGB+D", "RGB+ED")),
        ("absgrad", small[None], {"absgrad": True}),
        ("1,000", frustum_scene(1000, 504, 378), {}),
        ("10,000", frustum_scene(10_000, 256, 256), {}),
        ("50,000", frustum_scene(50_000, 128, 128), {}),
    ]
    if garden is not None:
        cases.append(("garden", garden_scene(garden, 4), {}))
    header = f"{'case':18} {'Gaussians':>9} {'image':>8} {'ms':>8} {'left out':>8} {'image':>8} {'alpha':>8}"
    print(header + "  worst gradient")
    rows = []
    for name, scene, options in cases:
        row = measure(name, scene, repeats, **options)
        rows.append(row)
        worst = max(row["gradient_errors"], key=lambda k: row["gradient_errors"][k])
        print(
            f"{row['case']:18} {row['gaussians']:9,} {row['image']:>8} {row['milliseconds']:8.1f}"
            f" {row['left_out']:8.2%} {row['image_error']:8.1e} {row['alpha_error']:8.1e}"
            f"  {row['gradient_errors'][worst]:.1e} {worst}",
            flush=True,
        )
    reference = against_gsplat()
    print("\nreference against gsplat's PyTorch functions, relative L2 difference")
    for name, difference in reference.items():
        print(f"  {name:24} {difference:.1e}")
    within = all(
        row["image_error"] < IMAGE_LIMIT and max(row["gradient_errors"].values()) < GRADIENT_LIMIT for row in rows
    )
    print(f"\nimage errors under {IMAGE_LIMIT:g} and gradient errors under {GRADIENT_LIMIT:g}: {within}")
    RESULTS.parent.mkdir(exist_ok=True)
    aside = RESULTS.with_suffix(".tmp")
    record = provenance() | {"within_limits": within, "rows": rows, "reference_against_gsplat": reference}
    aside.write_text(json.dumps(record, indent=1) + "\n")
    os.replace(aside, RESULTS)


if __name__ == "__main__":
    tyro.cli(main)
