"""PSNR, SSIM and LPIPS of rendered images, each with its exact definition. A new metric is one entry of METRICS."""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from skipgs_plug.core.ssim import ssim_map
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.exposure import fit_colours
from skipgs_plug.trainer.mask import leave_out

SSIM_FLAVOUR = "torchmetrics 1.9: 11x11 Gaussian window, borders reflected, mean over all windows"
LEAST_ERROR = 1e-10  # smallest mean squared error of an image, so that PSNR is at most 100 dB, not infinite
LPIPS_WEIGHTS = {"alex": "alexnet-owt-7be5be79.pth", "vgg": "vgg16-397923af.pth"}


@dataclass(frozen=True)
class Metric:
    """One metric, with everything that evaluations, tables and logs need.

    Attributes:
        name: Key in stats and results.
        label: Name in tables and messages.
        digits: Digits after the point.
        flavour: A clause that distinguishes it from other metrics of that name.
        measure: Function of render and target, images [H, W, 3], the target in [0, 1], and mask [H, W] or None.
        unit: Unit after the label.
        tag: Name in TensorBoard, as in gsplat; empty for the key.
        net: LPIPS backbone of a metric that is computed on request only; None for a metric of every evaluation.
        fitted: Whether it measures the render after `fit_colours`, for models that were trained with exposure.
    """

    name: str
    label: str
    digits: int
    flavour: str
    measure: Callable[[Tensor, Tensor, Tensor | None], float]
    unit: str = ""
    tag: str = ""
    net: str | None = None
    fitted: bool = False

    @property
    def heading(self) -> str:
        """Label and unit."""
        return f"{self.label} {self.unit}".strip()


def psnr(render: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return PSNR in dB of images [H, W, 3] clamped to [0, 1], over the pixels of `mask`; at most 100.

    Equal images would have an infinite PSNR, which means and files cannot hold.
    """
    squares = (render.clamp(0, 1) - target) ** 2
    error = float((squares if mask is None else squares[mask.to(squares.device)]).mean())
    return -10.0 * math.log10(max(error, LEAST_ERROR))


def ssim(render: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return SSIM of images [H, W, 3] in [0, 1], as torchmetrics computes it (see SSIM_FLAVOUR).

    With a mask [H, W]: the mean over windows whose centre counts. Both images should be black outside it.
    """
    windows = ssim_map(render.clamp(0, 1), target)
    return float((windows if mask is None else windows[mask.to(windows.device)]).mean())


def require_lpips(net: str) -> None:
    """Check that LPIPS can run without a download.

    Raises:
        InputError: torchvision or the backbone weights are not on this machine.
    """
    if importlib.util.find_spec("torchvision") is None:
        raise InputError("LPIPS needs torchvision; run: pip install torchvision, or leave out --lpips-net.")
    weights = Path(torch.hub.get_dir()) / "checkpoints" / LPIPS_WEIGHTS[net]
    if not weights.is_file():
        raise InputError(f"LPIPS needs the backbone weights {weights}; put them there, or leave out --lpips-net.")


def lpips(render: Tensor, target: Tensor, mask: Tensor | None = None, *, net: str) -> float:
    """Return LPIPS (`net` alex or vgg, inputs normalised to [-1, 1]) of images [H, W, 3] in [0, 1].

    It ignores `mask`: both images should be black outside it.
    """
    from torchmetrics.functional.image import learned_perceptual_image_patch_similarity

    require_lpips(net)
    first, second = batch(render.clamp(0, 1)), batch(target)
    return float(learned_perceptual_image_patch_similarity(first, second, net_type=net, normalize=True))  # type: ignore[arg-type]


def batch(image: Tensor) -> Tensor:
    """Return [H, W, 3] as [1, 3, H, W]."""
    return image.permute(2, 0, 1)[None]


def after_fit(
    measure: Callable[[Tensor, Tensor, Tensor | None], float],
) -> Callable[[Tensor, Tensor, Tensor | None], float]:
    """Return the metric after the colours of the render are fitted to the target."""

    def fitted(render: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
        image, target = leave_out(fit_colours(render, target, mask), target, mask)
        return measure(image, target, mask)

    return fitted


FITTED = "after the affine map of colours, fitted per image, that is closest to the target"

METRICS = {
    metric.name: metric
    for metric in (
        Metric("psnr", "PSNR", 2, "mean of per-image PSNR, float render clamped to [0, 1]", psnr, unit="dB"),
        Metric("ssim", "SSIM", 4, SSIM_FLAVOUR, ssim),
        # Names of gsplat.
        Metric("cc_psnr", "PSNR, colours fitted,", 2, FITTED, after_fit(psnr), unit="dB", fitted=True),
        Metric("cc_ssim", "SSIM, colours fitted", 4, f"{SSIM_FLAVOUR}; {FITTED}", after_fit(ssim), fitted=True),
        *(
            Metric(
                f"lpips_{net}", f"LPIPS {net}", 4, f"torchmetrics, backbone {net}, inputs normalised to [-1, 1]",
                functools.partial(lpips, net=net), tag="lpips", net=net,
            )
            for net in LPIPS_WEIGHTS
        ),
    )
}  # fmt: skip


def chosen(lpips_net: str | None = None, fitted: bool = False) -> list[Metric]:
    """Return the metrics of every evaluation, with LPIPS for a backbone, and with fitted colours if asked for."""
    return [metric for metric in METRICS.values() if metric.net in (None, lpips_net) and metric.fitted <= fitted]


def measure(metrics: Sequence[Metric], render: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, float]:
    """Return the metrics of a render against its target, images [H, W, 3], by name.

    Args:
        metrics: The metrics.
        render: Image [H, W, 3].
        target: Image [H, W, 3] in [0, 1].
        mask: Pixels that count, [H, W]; None for all.
    """
    return {metric.name: metric.measure(render, target, mask) for metric in metrics}
