"""Adam that updates only the Gaussians that a view shows (Taming 3DGS; gsplat's SelectiveAdam)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from skipgs_plug.fallback_raster import adam_rows, moments


class SelectiveAdam(torch.optim.Adam):
    """Adam without bias correction that updates moments and values of visible rows only.

    gsplat's class of that name runs on CUDA only. This class does the same on the CPU too.
    """

    def __init__(self, params: Any, eps: float) -> None:
        super().__init__(params, eps=eps)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Update the rows in which `visibility` [N] is True. Parameters without a gradient do not change."""
        for group in self.param_groups:
            for param in group["params"]:
                if param.grad is None:
                    continue
                state = moments(self, param)
                state["step"] += 1
                means = state["exp_avg"], state["exp_avg_sq"]
                adam_rows(visibility, param, *means, group["lr"], group["betas"], group["eps"])
