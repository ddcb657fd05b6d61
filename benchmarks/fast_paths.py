"""Time that each fast path of the CPU backend saves, and its error.

    python benchmarks/fast_paths.py [--steps 2000] [--seeds 0 1]

Fast paths are switched on one after the other. The first run uses none: 2^t in float64, the loss by PyTorch's
convolutions, plain Adam. Errors are those of one pass over 10,000 random Gaussians, relative to the exact pass. fern at
252x189 is then trained with each, and its PSNR on held-out views is printed with the time. Optimizations of the
rasterizer that do not change results are measured by `raster.py --parts optimizations`. Writes
`benchmarks/results/fast_paths.json`.
"""

from __future__ import annotations

import dataclasses
import re
import statistics
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
import tyro
from common import (
    PARAMETERS,
    RESULTS,
    SCENES,
    frustum_scene,
    leaves,
    provenance,
    relative_difference,
    threads,
    write_part,
)

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.runtime import launch
from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.fallback_raster.stages import blend
from skipgs_plug.trainer import TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.backend import Backend, resolve_backend
from skipgs_plug.trainer.loss import l1_ssim_loss as convolved_loss

# The integer part of t goes to the exponent; 14 terms of the Taylor series give 2^f of the rest f with an error of
# 1e-17.
EXACT_EXP2 = """auto exp2 = [](v16 t) -> v16 {
    typedef double d16 __attribute__((ext_vector_type(16)));
    typedef long long l16 __attribute__((ext_vector_type(16)));
    d16 x = __builtin_convertvector(t > -120.0f ? t : (v16)-120.0f, d16);
    d16 r = x + 6755399441055744.0, f = (x - (r - 6755399441055744.0)) * 0.69314718055994530942, p = (d16)1.0;
    for (int k = 14; k > 0; --k) p = 1.0 + p * f / (double)k;
    return __builtin_convertvector((d16)((l16)p + ((l16)r << 52)), v16);
};
"""


@contextmanager
def exact_exponential() -> Iterator[None]:
    """Blend with 2^t in float64 inside the `with` statement."""
    workers = [*blend.FORWARD.values(), *blend.ADJOINT.values()]
    kept = launch.PRELUDE, [(worker.name, worker._kernel) for worker in workers]
    launch.PRELUDE = re.sub(r"auto exp2 = .*?\n};\n", EXACT_EXP2, launch.PRELUDE, flags=re.DOTALL)
    assert kept[0] != launch.PRELUDE
    for worker in workers:
        worker.name, worker._kernel = f"{worker.name}_exact", None
    try:
        yield
    finally:
        launch.PRELUDE = kept[0]
        for worker, (name, command) in zip(workers, kept[1], strict=True):
            worker.name, worker._kernel = name, command


@dataclasses.dataclass
class Path:
    """One combination of fast paths."""

    label: str
    exact_exp: bool
    fused_loss: bool
    selective: bool

    @property
    def backend(self) -> Backend:
        fused = resolve_backend("warp")
        return fused if self.fused_loss else dataclasses.replace(fused, loss=convolved_loss)

    @contextmanager
    def exponential(self) -> Iterator[None]:
        if self.exact_exp:
            with exact_exponential():
                yield
        else:
            yield


PATHS = (
    Path("exact", True, False, False),
    Path("+ exp by polynomial", False, False, False),
    Path("+ fused loss (default)", False, True, False),
    Path("+ selective Adam (option)", False, True, True),
)


def one_pass(path: Path) -> dict[str, Any]:
    """Return the image, and the gradients of the training loss."""
    scene = frustum_scene(10_000, 252, 189)
    target = torch.rand(1, 189, 252, 3, generator=torch.Generator().manual_seed(0))
    inputs = leaves(scene, PARAMETERS)
    with threads(usable_cores()), path.exponential():
        image, _, _ = rasterization(**inputs, packed=False)
        path.backend.loss(image, target, 0.2).backward()
    return {"image": image.detach(), **{name: inputs[name].grad for name in PARAMETERS}}


def train(path: Path, steps: int, seed: int) -> tuple[float, float]:
    """Train, and return PSNR on held-out views in dB and milliseconds per iteration."""
    config = TrainConfig(max_steps=steps, seed=seed, visible_adam=path.selective, grow_grad2d=0.001)
    with path.exponential():
        trainer = Trainer(config, load_scene(SCENES / "fern", data_factor=2), path.backend)
        trainer.train(progress=False)
        return trainer.evaluate()["psnr"], 1000 * trainer.t_total / steps


def main(steps: int = 2000, seeds: tuple[int, ...] = (0, 1)) -> None:
    about = provenance()
    truth = one_pass(PATHS[0])
    rows = []
    print(f"{'path':28} {'ms/it':>6} {'image error':>11} {'gradient':>8}  test PSNR, dB")
    for path in PATHS:
        found = one_pass(path)
        image = (found["image"] - truth["image"]).abs().max().item()
        gradient = max(relative_difference(found[p], truth[p]) for p in PARAMETERS)
        psnr, ms = zip(*(train(path, steps, seed) for seed in seeds), strict=True)
        row = {"path": path.label, "steps": steps, "seeds": seeds, "ms_per_iteration": ms, "psnr": psnr}
        rows.append(row | {"image_error": image, "gradient_error": gradient})
        shown = ", ".join(f"{p:.2f}" for p in psnr)
        print(f"{path.label:28} {statistics.mean(ms):6.1f} {image:11.1e} {gradient:8.1e}  {shown}", flush=True)
    write_part(RESULTS / "fast_paths.json", "training", rows, about)


if __name__ == "__main__":
    tyro.cli(main)
