"""Time and error of the CPU rasterizer: float32 results compared with the float64 reference.

    python benchmarks/accuracy.py [--repeats 5]

Prints a table and writes it to `benchmarks/results/accuracy.json`. The time is that of one forward and backward pass,
the median of the repeats after one warm-up. Image and alpha errors are the largest absolute differences (for depth
relative to the largest depth). Gradient errors are relative L2 errors. Some pixels are left out, because rounding
decides there on which side of a jump they lie: pixels within 0.01 % of a cut-off (1/255, 0.999, transmittance 1e-4),
and pixels with two Gaussians at one depth. The column "left out" is their share. A last table compares the reference
itself with gsplat's PyTorch functions, both in float64. The garden is read from `$SKIPGS_SHARED/data/garden_points.npz`
(gsplat's test asset; default `../shared`) and left out if the file is missing.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
import tyro
from common import (
    RESULTS,
    SCENES,
    frustum_scene,
    garden_scene,
    median_ms,
    provenance,
    relative_difference,
    threads,
    write_results,
)
from torch import Tensor

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.oracle.torch_reference import near_cutoff, rasterization_reference
from skipgs_plug.fallback_raster.oracle.torch_reference_projection import rotation_matrices, spherical_harmonics
from skipgs_plug.fallback_raster.runtime.cores import usable_cores

FILE = RESULTS / "accuracy.json"
PARAMETERS = ("means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats")
# Largest errors that count as accurate: absolute differences of image and alpha, relative L2 errors of gradients.
IMAGE_LIMIT, GRADIENT_LIMIT = 1e-5, 1e-4
# Relative distance to a cut-off below which a pixel is left out: float32 rounds alphas by less.
BAND = 1e-4


def frustum(n: int, width: int, height: int, sh_degree: int | None = None) -> dict[str, Any]:
    """Return the scene of the speed benchmarks, with a coloured background."""
    background = torch.rand(1, 3, generator=torch.Generator().manual_seed(0))
    return frustum_scene(n, width, height, 0, sh_degree) | {"backgrounds": background}


def garden(downscale: int) -> dict[str, Any]:
    """Return the scene of the speed benchmarks with three different axes per Gaussian, so that rotations matter."""
    scene = garden_scene(downscale)
    n, generator = len(scene["means"]), torch.Generator().manual_seed(0)
    scene["scales"] *= 0.5 + torch.rand(n, 3, generator=generator)
    scene["quats"] = torch.randn(n, 4, generator=generator)
    return scene | {"backgrounds": torch.zeros(1, 3)}


class Pass(NamedTuple):
    """One forward and backward pass."""

    values: dict[str, Tensor]  # image, alpha, and the gradients by name
    keep: Tensor  # [C, H, W, 1] mask of the pixels that are compared
    seconds: float


def run(
    function: Callable[..., Any],
    scene: dict[str, Any],
    dtype: torch.dtype,
    keep: Tensor | None = None,
    **options: Any,
) -> Pass:
    """Run forward and backward pass, with a random gradient for the pixels in `keep`. If None, `keep` is computed."""
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
    for name in PARAMETERS:  # colors and backgrounds have no gradient in images of depth
        if inputs[name].grad is not None and inputs[name].grad.any():
            values[name] = inputs[name].grad
    return Pass(values, keep, seconds)


def measure(name: str, scene: dict[str, Any], repeats: int, **options: Any) -> dict[str, Any]:
    """Return one row of the table."""
    reference = run(rasterization_reference, scene, torch.float64, **options)
    passes = [run(rasterization, scene, torch.float32, reference.keep, **options) for _ in range(repeats + 1)]
    truth, value = reference.values, passes[-1].values
    greatest = max(1.0, truth["image"].abs().max().item())
    return {
        "case": name,
        "gaussians": len(scene["means"]),
        "image": f"{scene['width']}x{scene['height']}",
        "milliseconds": median_ms([p.seconds for p in passes[1:]]),
        "left_out": 1 - reference.keep.double().mean().item(),
        "image_error": (value["image"] - truth["image"]).abs().max().item() / greatest,
        "alpha_error": (value["alpha"] - truth["alpha"]).abs().max().item(),
        "gradient_errors": {k: relative_difference(value[k], truth[k]) for k in truth if k not in ("image", "alpha")},
    }


def against_gsplat() -> dict[str, float]:
    """Return relative L2 differences of values and gradients between the reference and gsplat's `_torch_impl`."""
    from gsplat.cuda import _torch_impl as theirs

    generator = torch.Generator().manual_seed(0)
    scene = frustum(2000, 128, 96)
    scene["opacities"] = torch.ones_like(scene["opacities"])
    differences = {}
    for degree in range(4):
        directions = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
        coeffs = torch.randn(1000, 16, 3, generator=generator, dtype=torch.float64)
        truth = theirs._spherical_harmonics(degree, directions, coeffs)
        differences[f"SH degree {degree}"] = relative_difference(spherical_harmonics(degree, directions, coeffs), truth)
    results = []
    for ours in (True, False):
        names = ("means", "quats", "scales", "viewmats")
        inputs = dict(scene) | {name: scene[name].double().requires_grad_() for name in names}
        inputs |= {name: scene[name].double() for name in ("opacities", "colors", "Ks", "backgrounds")}
        if ours:
            *_, info = rasterization_reference(**inputs, packed=False, rasterize_mode="antialiased")
            visible = (info["radii"] > 0).all(dim=-1)
            rows = {name: info[name][visible] for name in ("means2d", "depths", "conics")}
            rows["compensation"] = info["opacities"][visible]
            axes = rotation_matrices(inputs["quats"]) * inputs["scales"][:, None, :]
            rows["covariance"] = axes @ axes.transpose(-1, -2)
        else:
            covariance, _ = theirs._quat_scale_to_covar_preci(inputs["quats"], inputs["scales"], True, False)
            camera = inputs["viewmats"], inputs["Ks"], inputs["width"], inputs["height"]
            _, *projected = theirs._fully_fused_projection(
                inputs["means"], covariance, *camera, calc_compensations=True
            )
            names2d = ("means2d", "depths", "conics", "compensation")
            rows = {name: value[visible] for name, value in zip(names2d, projected, strict=True)}
            rows["covariance"] = covariance
        sum(row.square().sum() for row in rows.values()).backward()
        results.append(rows | {f"gradient of {name}": inputs[name].grad for name in names})
    return differences | {name: relative_difference(results[0][name], results[1][name]) for name in results[1]}


def main(repeats: int = 5) -> None:
    """Measure all cases.

    Args:
        repeats: Timed passes of each case.
    """
    about = provenance() | {"threads": usable_cores()}
    small = {degree: frustum(2000, 128, 96, degree) for degree in (None, 0, 1, 2, 3)}
    cases: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
        ("plain colors", small[None], {}),
        *((f"SH {degree}", small[degree], {}) for degree in range(4)),
        ("antialiased, SH 3", small[3], {"rasterize_mode": "antialiased"}),
        *((mode, small[None], {"render_mode": mode}) for mode in ("D", "ED", "RGB+D", "RGB+ED")),
        ("absgrad", small[None], {"absgrad": True}),
        ("1,000", frustum(1000, 504, 378), {}),
        ("10,000", frustum(10_000, 256, 256), {}),
        ("50,000", frustum(50_000, 128, 128), {}),
    ]
    if (SCENES / "garden_points.npz").is_file():
        cases.append(("garden", garden(4), {}))
    header = f"{'case':18} {'Gaussians':>9} {'image':>8} {'ms':>8} {'left out':>8} {'image':>8} {'alpha':>8}"
    print(header + "  worst gradient")
    rows = []
    for name, scene, options in cases:
        with threads(usable_cores()):
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
    write_results(FILE, about | {"within_limits": within, "rows": rows, "reference_against_gsplat": reference})


if __name__ == "__main__":
    tyro.cli(main)
