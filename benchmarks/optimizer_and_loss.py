"""Time of Adam for all parameters, and of the loss, on one core and on all.

    python benchmarks/optimizer_and_loss.py [--quick]

Adam steps the six parameters of a model of SH degree 3 (59 numbers per Gaussian). Our implementation is compared with
torch's fused and default ones, which run on one thread of torch, as in training. The loss computes value and gradient
for one image, and is compared with the trainer's plain version in torch. Calls alternate. Times are medians and minima;
other programs disturb minima least. The errors of Adam are the share of numbers that are not bit-equal to torch's fused
Adam after 20 steps with random gradients, and the largest difference in units of the learning rate. The error of the
loss is the relative error of its gradient, compared with float64. Writes `benchmarks/results/optimizer_and_loss.json`.
"""

from collections.abc import Callable
from typing import Any

import torch
import tyro
from common import RESULTS, clock, median_ms, provenance, relative_difference, threads, write_part
from torch import Tensor

from skipgs_plug.fallback_raster import l1_ssim_loss
from skipgs_plug.fallback_raster.runtime.cores import usable_cores
from skipgs_plug.fallback_raster.training.optimizer import Adam
from skipgs_plug.trainer.loss import l1_ssim_loss as plain_loss

FILE = RESULTS / "optimizer_and_loss.json"
SHAPES = ((3,), (3,), (4,), (), (1, 3), (15, 3))  # shapes of a Gaussian's parameters at SH degree 3
RATE = 1e-3  # learning rate
OPTIMIZERS: dict[str, Callable[[list[Tensor]], torch.optim.Optimizer]] = {
    "ours": lambda params: Adam(params, lr=RATE, eps=1e-15),
    "torch fused": lambda params: torch.optim.Adam(params, lr=RATE, eps=1e-15, fused=True),
    "torch": lambda params: torch.optim.Adam(params, lr=RATE, eps=1e-15),
}
LOSSES: dict[str, Callable[[Tensor, Tensor], Tensor]] = {"ours": l1_ssim_loss, "torch": plain_loss}


def model(n: int) -> list[Tensor]:
    """Return parameters of n Gaussians with gradients, the same in each call."""
    generator = torch.Generator().manual_seed(0)
    params = [torch.nn.Parameter(torch.randn(n, *shape, generator=generator)) for shape in SHAPES]
    for param in params:
        param.grad = torch.randn(param.shape, generator=generator)
    return list(params)


def alternating(works: dict[str, Callable[[], Any]], count: int, rounds: int) -> dict[str, dict[str, float]]:
    """Return milliseconds of each call. Calls alternate."""
    seconds: dict[str, list[float]] = {name: [] for name in works}
    with threads(count):
        for _ in range(rounds):
            for name, work in works.items():
                seconds[name].append(clock(work))
    return {name: {"ms": median_ms(values), "ms_min": 1000 * min(values)} for name, values in seconds.items()}


def adam_rows(n: int, counts: list[int], rounds: int) -> list[dict[str, Any]]:
    """Return the times of all optimizers for n Gaussians."""
    steps = {name: make(model(n)).step for name, make in OPTIMIZERS.items()}
    error = adam_error()
    rows = []
    for count in counts:
        for name, times in alternating(steps, count, rounds).items():
            row = {"part": "adam", "size": f"{n:,}", "threads": count, "which": name, **times}
            rows.append(row | (error if name == "ours" else {}))
    return rows


def adam_error() -> dict[str, float]:
    """Return how our Adam differs from torch's fused one after 20 steps of 10,000 Gaussians."""
    models = model(10_000), model(10_000)
    optimizers = OPTIMIZERS["ours"](models[0]), OPTIMIZERS["torch fused"](models[1])
    generator = torch.Generator().manual_seed(1)
    for _ in range(20):
        for a, b in zip(*models, strict=True):
            a.grad = b.grad = torch.randn(a.shape, generator=generator)
        for optimizer in optimizers:
            optimizer.step()
    a, b = (torch.cat([param.detach().flatten() for param in params]) for params in models)
    return {"bits_differ": (a != b).double().mean().item(), "most_in_rates": (a - b).abs().max().item() / RATE}


def loss_rows(width: int, height: int, counts: list[int], rounds: int) -> list[dict[str, Any]]:
    """Return times and errors of value and gradient for one image."""
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(height, width, 3, generator=generator)
    noise = 0.2 * torch.randn(target.shape, generator=generator)
    image = (target + noise).clamp(0, 1)
    exact = gradient(plain_loss, image.double(), target.double())
    rows = []
    for count in counts:
        works = {name: lambda loss=loss: gradient(loss, image, target) for name, loss in LOSSES.items()}
        for name, times in alternating(works, count, rounds).items():
            error = relative_difference(gradient(LOSSES[name], image, target), exact)
            row = {"part": "loss", "size": f"{width}x{height}", "threads": count, "which": name, **times}
            rows.append(row | {"gradient_error": error})
    return rows


def gradient(loss: Callable[[Tensor, Tensor], Tensor], image: Tensor, target: Tensor) -> Tensor:
    leaf = image.detach().requires_grad_()
    (slope,) = torch.autograd.grad(loss(leaf, target), leaf)
    return slope


def main(quick: bool = False) -> None:
    """Measure optimizer and loss.

    Args:
        quick: Measure only the smaller sizes.
    """
    about = provenance() | {"quick": quick}
    print(f"{about['cpu']}, {about['cores']} cores, commit {about['commit']}")
    counts, rows = sorted({1, usable_cores()}), []
    for n, rounds in ((10_000, 40), (100_000, 15)) if quick else ((10_000, 40), (100_000, 15), (1_000_000, 7)):
        rows += adam_rows(n, counts, rounds)
    for width, height, rounds in ((504, 378, 40),) if quick else ((504, 378, 40), (1920, 1080, 7)):
        rows += loss_rows(width, height, counts, rounds)
    for row in rows:
        errors = ", ".join(f"{name} {row[name]:.1e}" for name in row if name.startswith(("bits", "most", "gradient")))
        label = f"{row['part']:5} {row['size']:>9} {row['threads']} threads {row['which']:12}"
        print(f"{label} {row['ms']:8.2f} ms, at least {row['ms_min']:8.2f}  {errors}")
    write_part(FILE, "all", rows, about)


if __name__ == "__main__":
    tyro.cli(main)
