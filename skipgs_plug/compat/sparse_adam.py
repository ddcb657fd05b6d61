"""Adam that does not update invisible Gaussians, as in the accelerated rasterizers."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from skipgs_plug.fallback_raster import adam_rows, moments
from skipgs_plug.fallback_raster.runtime.function_modes import without_function_modes


class SparseGaussianAdam(torch.optim.Adam):
    """Adam without bias correction, as in the CUDA kernel. Each group has one parameter, with N rows."""

    def __init__(self, params: Any, lr: float, eps: float) -> None:
        super().__init__(params=params, lr=lr, eps=eps)

    @torch.no_grad()
    @without_function_modes
    def step(self, visibility: Tensor, N: int) -> None:  # type: ignore[override]
        """Update the visible rows of every parameter that has a gradient.

        Args:
            visibility: Rows to update. [N] bool
            N: Number of Gaussians.
        """
        for group in self.param_groups:
            (param,) = group["params"]
            if param.grad is None:
                continue
            state = moments(self, param)
            means = state["exp_avg"], state["exp_avg_sq"]
            adam_rows(visibility.reshape(N), param, *means, group["lr"], (0.9, 0.999), group["eps"])
