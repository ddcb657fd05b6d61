"""Expands a footprint to the (pixel, Gaussian) pairs that contribute to an image, in blending order.

This is slow compared with a blend kernel. It serves for sums that no kernel computes: squared gradients (Speedy-Splat)
and intersections of view rays (GaussianSpa).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.oracle.torch_reference import ALPHA_MAX, ALPHA_THRESHOLD, TRANSMITTANCE_STOP

from .statistics import Footprint

# Image rows that are expanded at a time. It bounds the memory, because all pairs of a strip are held at once.
ROWS_PER_STRIP = 32


class Pairs(NamedTuple):
    """Contributions, sorted by pixel and front to back within it."""

    gaussian: Tensor  # [P] int64
    pixel: Tensor  # [P] int64, row-major over the whole image
    offset: Tensor  # [P, 2] pixel centre minus 2D mean
    alpha: Tensor  # [P]
    transmittance: Tensor  # [P] in front of the Gaussian

    @property
    def weight(self) -> Tensor:
        """Blend weights. [P]"""
        return self.alpha * self.transmittance


@torch.no_grad()
def pairs_by_strip(footprint: Footprint) -> Iterator[Pairs]:
    """Yield the pairs of a footprint, one strip of image rows at a time."""
    for top in range(0, footprint.height, ROWS_PER_STRIP):
        yield _strip(footprint, top, min(top + ROWS_PER_STRIP, footprint.height))


def strongest(pairs: Pairs, candidates: Tensor | None = None) -> Tensor:
    """Return indices of the pairs with the largest weight of their pixel. Of equal weights, the front one counts.

    Args:
        pairs: The pairs of a strip.
        candidates: Mask of the pairs that count. [P] bool; all if None.
    """
    rows = torch.arange(len(pairs.pixel)) if candidates is None else candidates.nonzero()[:, 0]
    pixel, weight = pairs.pixel[rows], pairs.weight[rows]
    _, group = torch.unique_consecutive(pixel, return_inverse=True)
    largest = torch.zeros(int(group[-1]) + 1 if len(group) else 0).scatter_reduce(0, group, weight, "amax")
    rows, group = rows[weight == largest[group]], group[weight == largest[group]]
    first = torch.ones_like(group, dtype=torch.bool)
    first[1:] = group[1:] != group[:-1]
    return rows[first]


@torch.no_grad()
def squared_gradients(footprint: Footprint, rgb: Tensor, background: Tensor, grad_image: Tensor) -> Tensor:
    """Sum the squared gradient of each pixel by the Gaussian's falloff (Speedy-Splat's pruning score).

    Args:
        footprint: The projected scene.
        rgb: Colours of the Gaussians. [N, 3]
        background: Colour of the background. [3]
        grad_image: Gradient of the loss by the image. [3, H, W]

    Returns:
        Sums over pixels of squares. [N]
    """
    grad = grad_image.reshape(3, -1).T.double()  # [H * W, 3]
    behind_all = grad @ background.double()
    total = torch.zeros(len(footprint), dtype=torch.float64)
    for pairs in pairs_by_strip(footprint):
        alpha, weight = pairs.alpha.double(), pairs.weight.double()
        shade = (rgb[pairs.gaussian].double() * grad[pairs.pixel]).sum(dim=1)
        _, group = torch.unique_consecutive(pairs.pixel, return_inverse=True)
        light = weight * shade
        upto = light.cumsum(0)
        whole = torch.zeros(int(group[-1]) + 1 if len(group) else 0, dtype=torch.float64)
        ends = whole.index_add(0, group, light).cumsum(0)
        leaving = torch.zeros_like(whole).index_add(0, group, torch.log1p(-alpha)).exp()
        behind = ends[group] - upto + leaving[group] * behind_all[pairs.pixel]
        by_alpha = pairs.transmittance.double() * shade - behind / (1 - alpha)
        by_falloff = footprint.opacities[pairs.gaussian].double() * by_alpha
        total.index_add_(0, pairs.gaussian, by_falloff * by_falloff)
    return total.to(rgb.dtype)


def _strip(f: Footprint, top: int, bottom: int) -> Pairs:
    a, b, c = f.conics.unbind(-1)
    # The half width of the ellipse alpha = ALPHA_THRESHOLD is sqrt(2 ln(255 opacity) * covariance).
    determinant = torch.where(f.drawn, a * c - b * b, 1.0)
    power = 2 * (f.opacities / ALPHA_THRESHOLD).clamp_min(1.0).log()
    reach = (power[:, None] * torch.stack([c, a], dim=-1) / determinant[:, None]).clamp_min(0.0).sqrt()
    low, high = f.means2d - reach - 0.5, f.means2d + reach - 0.5
    limit = torch.tensor([f.width - 1, bottom - 1])
    first = low.floor().clamp_min(0.0).maximum(torch.tensor([0.0, float(top)])).long()
    last = high.ceil().minimum(limit.to(high)).clamp_min(-1.0).long()
    size = (last - first + 1).clamp_min(0)

    order = torch.sort(f.depths, stable=True).indices
    order = order[f.drawn[order] & (size[order] > 0).all(dim=-1)]
    counts = size[order].prod(dim=-1)
    gaussian = order.repeat_interleave(counts)
    step = torch.arange(len(gaussian)) - (counts.cumsum(0) - counts).repeat_interleave(counts)
    x = first[gaussian, 0] + step % size[gaussian, 0]
    y = first[gaussian, 1] + step // size[gaussian, 0]

    offset = torch.stack([x, y], dim=-1) + 0.5 - f.means2d[gaussian]
    dx, dy = offset.unbind(-1)
    sigma = 0.5 * (a[gaussian] * dx * dx + c[gaussian] * dy * dy) + b[gaussian] * dx * dy
    alpha = f.opacities[gaussian] * torch.exp(-sigma)
    drawn = (alpha >= ALPHA_THRESHOLD) & (sigma >= 0)
    gaussian, pixel, offset, alpha = gaussian[drawn], (y * f.width + x)[drawn], offset[drawn], alpha[drawn]

    pixel, by_pixel = torch.sort(pixel, stable=True)
    gaussian, offset, alpha = gaussian[by_pixel], offset[by_pixel], alpha[by_pixel].clamp_max(ALPHA_MAX)
    # log of the transmittance: a running sum of log(1 - alpha), minus its value at the start of the pixel.
    absorbed = torch.log1p(-alpha.double())
    after = absorbed.cumsum(0)
    _, group, lengths = torch.unique_consecutive(pixel, return_inverse=True, return_counts=True)
    start = (after - absorbed)[lengths.cumsum(0) - lengths]
    after = after - start[group]
    kept = after.exp() > TRANSMITTANCE_STOP
    light = (after - absorbed).exp().to(alpha.dtype)
    return Pairs(gaussian[kept], pixel[kept], offset[kept], alpha[kept], light[kept])
