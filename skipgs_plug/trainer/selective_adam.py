"""Adam that touches only the Gaussians a view shows (Taming 3DGS; gsplat's SelectiveAdam, any device)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class SelectiveAdam(torch.optim.Adam):
    """Adam without bias correction whose moments and values move only for visible rows.

    gsplat's class of that name runs in CUDA; this one has its semantics in plain torch.
    """

    def __init__(self, params: Any, eps: float, betas: tuple[float, float] = (0.9, 0.999)) -> None:
        super().__init__(params, eps=eps, betas=betas)

    @torch.no_grad()
    def step(self, visibility: Tensor) -> None:  # type: ignore[override]
        """Update rows where `visibility` [N] bool holds; no-op for parameters without gradient."""
        rows = torch.nonzero(visibility)[:, 0]
        for group in self.param_groups:
            beta1, beta2 = group["betas"]
            for param in group["params"]:
                if param.grad is None:
                    continue
                state = self.state[param]
                if not state:
                    state["step"] = torch.tensor(0.0)
                    state["exp_avg"] = torch.zeros_like(param)
                    state["exp_avg_sq"] = torch.zeros_like(param)
                state["step"] += 1
                grad = param.grad[rows]
                mean = torch.lerp(grad, state["exp_avg"][rows], beta1)
                square = torch.lerp(grad * grad, state["exp_avg_sq"][rows], beta2)
                state["exp_avg"][rows] = mean
                state["exp_avg_sq"][rows] = square
                param[rows] -= group["lr"] * mean / (square.sqrt() + group["eps"])
