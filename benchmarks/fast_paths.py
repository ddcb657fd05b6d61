"""What each fast path of the CPU backend gains, beside what it costs in accuracy.

    python benchmarks/fast_paths.py [--parts exponential training] [--steps 2000] [--seeds 0 1]

What the shortcuts of the rasterizer gain is in `raster.py --parts shortcuts`: they change no result.
`exponential`: the blend's own 2^t against float64.
`training`: fern at 252x189, trained with the fused or the plain PyTorch loss, with Adam or the selective Adam; test
PSNR is the error. Writes `benchmarks/results/fast_paths.json`.
"""

from __future__ import annotations

import dataclasses
import statistics
from typing import Any, Literal

import torch
import tyro
from common import RESULTS, SCENES, provenance, write_part

from skipgs_plug.fallback_raster.launch import FloatArray, worker
from skipgs_plug.trainer import TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.loss import l1_ssim_loss as plain_loss


@worker(
    "for (int i = first; i < last; i += 16) store(out + i, exp2(load(t + i)));",
    items="n",
    grain=4096,
)
def kernel_exp2(t: FloatArray, out: FloatArray, n: int) -> None: ...


def exponential() -> list[dict[str, Any]]:
    t = (torch.rand(1 << 20) * -8.0).contiguous()
    out = torch.empty_like(t)
    kernel_exp2(t, out, t.numel())
    exact = torch.exp2(t.double())
    polynomial = ((out - exact) / exact).abs().max().item()
    torch_error = ((torch.exp2(t) - exact) / exact).abs().max().item()
    print(f"2^t on [-8, 0], greatest relative error: kernel {polynomial:.1e}, torch float32 {torch_error:.1e}")
    return [{"kernel": polynomial, "torch": torch_error}]


def training(steps: int, seeds: list[int]) -> list[dict[str, Any]]:
    scene = load_scene(SCENES / "fern", data_factor=2)
    fused = resolve_backend("warp")
    plain = dataclasses.replace(fused, loss=plain_loss)
    paths = {
        "plain loss, Adam": (plain, False),
        "fused loss, Adam (default)": (fused, False),
        "fused loss, selective Adam": (fused, True),
    }
    rows = []
    for label, (backend, selective) in paths.items():
        psnr, ms = [], []
        for seed in seeds:
            trainer = Trainer(TrainConfig(max_steps=steps, seed=seed, visible_adam=selective), scene, backend)
            trainer.train(progress=False)
            psnr.append(trainer.evaluate()["psnr"])
            ms.append(1000 * trainer.t_total / steps)
        rows.append({"path": label, "steps": steps, "seeds": seeds, "ms_per_iteration": ms, "psnr": psnr})
        print(f"{label:28} {statistics.mean(ms):6.1f} ms/it  test PSNR {', '.join(f'{p:.2f}' for p in psnr)} dB")
    return rows


def main(
    parts: tuple[Literal["exponential", "training"], ...] = ("exponential", "training"),
    steps: int = 2000,
    seeds: tuple[int, ...] = (0, 1),
) -> None:
    about = provenance()
    path = RESULTS / "fast_paths.json"
    if "exponential" in parts:
        write_part(path, "exponential", exponential(), about)
    if "training" in parts:
        write_part(path, "training", training(steps, list(seeds)), about)


if __name__ == "__main__":
    tyro.cli(main)
