"""New opacities and scales of a Gaussian that MCMC densification splits into equal ones."""

from __future__ import annotations

import torch
from torch import Tensor


def compute_relocation(
    opacities: Tensor, scales: Tensor, ratios: Tensor, binoms: Tensor, min_opacity: float | None = None
) -> tuple[Tensor, Tensor]:
    """Compute opacity and scales of Gaussians that are split into `ratios` equal ones (3DGS-MCMC, equation 9).

    Args:
        opacities: Opacities [N], or [N, 1] as in nerfstudio.
        scales: Standard deviations. [N, 3]
        ratios: Number of copies, capped at n_max. [N]
        binoms: Binomial coefficients. [n_max, n_max]
        min_opacity: Smallest new opacity. gsplat passes it from 1.6 on; earlier versions apply it themselves.

    Returns:
        New opacities, in the shape of the old ones, and scales [N, 3]. The copies, drawn over each other, look like the
        original.
    """
    n_max = len(binoms)
    copies = ratios.clamp(min=1, max=n_max).long()
    flat = opacities.flatten()
    shared = 1 - (1 - flat) ** (1 / copies)
    if min_opacity is not None:
        shared = shared.clamp(min_opacity, 1 - torch.finfo(shared.dtype).eps)
    k = torch.arange(n_max)
    signs = torch.where(k % 2 == 0, 1.0, -1.0) / (k + 1).sqrt()
    rows = (binoms * signs * shared[:, None, None] ** (k + 1)).tril().sum(dim=2)  # [N, n_max]
    denominator = torch.where(k < copies[:, None], rows, 0.0).sum(dim=1)
    return shared.view_as(opacities), (flat / denominator)[:, None] * scales
