"""The order of the Gaussians' rows: neighbours in space are neighbours in memory.

A camera sees part of a scene. If rows follow a Morton curve (Morton 1966) through space, the CPU rasterizer can skip 16
rows at a time outside the view, and the rows of a tile lie close together in memory. Densification appends rows, so all
rows are sorted again from time to time, with the state of optimizers and strategy. So Gaussians are not in the order of
the points, and PLY files and checkpoints hold sorted rows.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.fallback_raster import take_rows

EVERY = 4  # densifications between two sorts: one densification adds few rows, and sorting all rows takes longer
BITS = 10  # bits per coordinate in a Morton code: three coordinates fit a 32-bit integer
# Share of the centres at either end of an axis that lies outside the grid. Without it, a few far centres would put all
# others into one cell.
MARGIN = 0.02


def sorts_rows(strategy: Any, step: int) -> bool:
    """Whether rows are sorted after iteration `step`: at every fourth densification and at the last one."""
    every = strategy.refine_every
    if step % every or not strategy.refine_start_iter < step < strategy.refine_stop_iter:
        return False
    return step % (EVERY * every) == 0 or step + every >= strategy.refine_stop_iter


@torch.no_grad()
def sort_rows(
    splats: nn.ParameterDict, optimizers: dict[str, torch.optim.Optimizer], strategy_state: dict[str, Any]
) -> None:
    """Sort the rows of all parameters, gradients, moments and sums of the strategy along the Morton curve.

    Parameters stay the same objects.
    """
    order = morton_order(splats["means"])
    n = len(order)
    for name, param in splats.items():
        state = optimizers[name].state.get(param, {})
        for tensor in (param, *state.values()):
            if isinstance(tensor, Tensor) and tensor.shape[:1] == (n,):
                tensor.copy_(tensor[order])
        if param.grad is not None:  # a gate may postpone the step
            param.grad = param.grad.index_select(0, order)
    for key, value in strategy_state.items():
        if isinstance(value, Tensor) and value.shape[:1] == (n,):
            strategy_state[key] = value[order]


def morton_order(means: Tensor) -> Tensor:
    """Return the rows [N] of `means` [N, 3] along a Morton curve; equal cells keep their order."""
    n = len(means)
    first = max(1, round(MARGIN * n))
    low = torch.stack([means[:, axis].kthvalue(first).values for axis in range(3)])
    high = torch.stack([means[:, axis].kthvalue(n + 1 - first).values for axis in range(3)])
    extent = (high - low).max().clamp(min=1e-20)
    cells = ((means - low) / extent * 2**BITS).clamp(0, 2**BITS - 1).to(torch.int64)
    code = torch.zeros(n, dtype=torch.int64, device=means.device)
    for bit in range(BITS):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return torch.argsort(code, stable=True)


def take(tensor: Tensor, rows: Tensor) -> Tensor:
    """Return `tensor[rows]`. On the CPU it uses all cores, and large pages for large results, which are read faster."""
    if tensor.device.type == "cpu":
        return take_rows(tensor, rows.to(torch.int32))
    return tensor[rows]
