"""What each fast path of the CPU backend gains, beside what it costs in accuracy.

    python benchmarks/fast_paths.py [--parts shortcuts training] [--steps 2000] [--seeds 0 1]

`shortcuts`: forward and backward of one image with every shortcut, and without one at a time; the loss covers the
lower half of the image, so half of the tiles receive no gradient. Errors are against the run with all of them.
`exponential`: the blend's own 2^t against float64.
`training`: fern at 252x189, trained with the fused or the plain PyTorch loss, with Adam or the selective Adam; test
PSNR is the error. Writes `benchmarks/results/fast_paths.json`.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from typing import Any, Literal

import torch
import tyro
from common import RESULTS, SCENES, frustum_scene, garden_scene, leaves, median_ms, provenance, write_part

from skipgs_plug.fallback_raster import rasterization
from skipgs_plug.fallback_raster.launch import FloatArray, worker
from skipgs_plug.fallback_raster.shortcuts import SHORTCUTS, without_shortcuts
from skipgs_plug.trainer import TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.loss import l1_ssim_loss as plain_loss

PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


@worker(
    "for (int i = first; i < last; i += 16) store(out + i, exp2(load(t + i)));",
    items="n",
    grain=4096,
)
def kernel_exp2(t: FloatArray, out: FloatArray, n: int) -> None: ...


def render(scene: dict[str, Any], weights: torch.Tensor) -> tuple[float, torch.Tensor, list[torch.Tensor]]:
    scene = leaves(scene, PARAMETERS)
    start = time.perf_counter()
    image, _, _ = rasterization(**scene, packed=False)
    (image * weights).sum().backward()
    seconds = time.perf_counter() - start
    return seconds, image.detach(), [scene[name].grad for name in PARAMETERS]


def shortcuts(repeats: int) -> list[dict[str, Any]]:
    rows = []
    scenes = {
        "frustum 50,000, 504x378, SH 3": frustum_scene(50_000, 504, 378, sh_degree=3),
        "garden, 648x420, SH 3": garden_scene(1, sh_degree=3),
    }
    for label, scene in scenes.items():
        weights = torch.randn(1, scene["height"], scene["width"], 3)
        weights[:, : scene["height"] // 2] = 0
        seconds: dict[str, list[float]] = {name: [] for name in ("all on", *SHORTCUTS)}
        errors: dict[str, tuple[float, float]] = {}
        for _ in range(repeats + 1):  # in turn, so that a slow moment hits all alike
            _, image, gradients = render(scene, weights)
            for name in seconds:
                with without_shortcuts(*([] if name == "all on" else [name])):
                    spent, other, others = render(scene, weights)
                seconds[name].append(spent)
                worst = max(((a - b).norm() / a.norm()).item() for a, b in zip(gradients, others, strict=True))
                errors[name] = ((image - other).abs().max().item(), worst)
        base = median_ms(seconds["all on"][1:])
        for name in seconds:
            ms = median_ms(seconds[name][1:])
            gain = ms / base
            rows.append(
                {
                    "scene": label,
                    "without": name,
                    "ms": ms,
                    "gain": gain,
                    "image_error": errors[name][0],
                    "gradient": errors[name][1],
                }
            )
            print(f"{label:32} without {name:17} {ms:7.1f} ms  x{gain:4.2f}  image {errors[name][0]:.1e}", end="")
            print(f"  gradient {errors[name][1]:.1e}")
    return rows


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
    parts: tuple[Literal["shortcuts", "exponential", "training"], ...] = ("shortcuts", "exponential", "training"),
    repeats: int = 5,
    steps: int = 2000,
    seeds: tuple[int, ...] = (0, 1),
) -> None:
    about = provenance()
    path = RESULTS / "fast_paths.json"
    if "shortcuts" in parts:
        write_part(path, "shortcuts", shortcuts(repeats), about)
    if "exponential" in parts:
        write_part(path, "exponential", exponential(), about)
    if "training" in parts:
        write_part(path, "training", training(steps, list(seeds)), about)


if __name__ == "__main__":
    tyro.cli(main)
