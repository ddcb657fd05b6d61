"""Time and error of the fused loss, a part of `raster.py`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch
from common import median_ms, relative_difference, threads
from torch import Tensor

from skipgs_plug.fallback_raster import l1_ssim_loss
from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.trainer.loss import l1_ssim_loss as convolved_loss

EXACT_IMAGES = 3  # images of each size for which the loss is also computed in PyTorch and in float64


def part_loss(quick: bool, repeats: int, only: str | None) -> list[dict[str, Any]]:
    """Measure time and error of the fused L1 + SSIM loss and of PyTorch's convolutions. The truth is float64.

    PyTorch takes seconds for a large image, so only the first images are computed by it and in float64, on one thread.
    """
    print(f"{'image':>10} {'threads':>7} {'fused ms':>8} {'torch ms':>8} {'value error':>20} {'gradient error':>20}")
    rows = []
    for width, height in ((252, 189), (504, 378)) if quick else ((252, 189), (504, 378), (1008, 756), (1920, 1080)):
        pairs = [image_pair(width, height, seed) for seed in range(repeats + 2)]
        with threads(1):
            truths = [loss_pass(convolved_loss, a.double(), b.double())[1:] for a, b in pairs[:EXACT_IMAGES]]
            convolved = loss_figures("torch", convolved_loss, pairs[:EXACT_IMAGES], truths, warm_up=1)
        for count in sorted({1, usable_cores()}, reverse=True):
            with threads(count):
                fused = loss_figures("fused", l1_ssim_loss, pairs, truths, warm_up=2)
            row = {"size": f"{width}x{height}", "threads": count, **fused, **convolved}
            rows.append(row)
            both = [
                f"{row[f'fused_{kind}']:.1e} / {row[f'torch_{kind}']:.1e}" for kind in ("value_error", "gradient_error")
            ]
            print(
                f"{row['size']:>10} {count:7} {row['fused_ms']:8.2f} {row['torch_ms']:8.1f} "
                f"{both[0]:>20} {both[1]:>20}",
                flush=True,
            )
    return rows


def image_pair(width: int, height: int, seed: int) -> tuple[Tensor, Tensor]:
    """Return an image with noise, and the image without."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    return (target + 0.1 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1), target


def loss_pass(function: Callable[..., Tensor], image: Tensor, target: Tensor) -> tuple[float, float, Tensor]:
    """Return seconds, value and gradient of a loss."""
    leaf = image.clone().requires_grad_()
    start = time.perf_counter()
    loss = function(leaf, target)
    loss.backward()
    seconds = time.perf_counter() - start
    assert leaf.grad is not None
    return seconds, loss.item(), leaf.grad


def loss_figures(
    name: str,
    function: Callable[..., Tensor],
    pairs: list[tuple[Tensor, Tensor]],
    truths: list[tuple[float, Tensor]],
    warm_up: int,
) -> dict[str, float]:
    """Return times over all pairs of images without the warm-up, and the largest errors over pairs with a truth."""
    seconds, value_errors, gradient_errors = [], [], []
    # Gradients are compared and freed at once. New memory for each would add page faults to the time of the loss.
    for number, (image, target) in enumerate(pairs):
        elapsed, value, gradient = loss_pass(function, image, target)
        seconds.append(elapsed)
        if number < len(truths):
            truth, true_gradient = truths[number]
            value_errors.append(abs(value - truth))
            gradient_errors.append(relative_difference(gradient, true_gradient))
    seconds = seconds[warm_up:]
    return {
        f"{name}_ms": median_ms(seconds),
        f"{name}_ms_min": 1000 * min(seconds),
        f"{name}_value_error": max(value_errors),
        f"{name}_gradient_error": max(gradient_errors),
    }
