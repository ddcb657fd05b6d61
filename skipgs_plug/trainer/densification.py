"""Densification that moves every row once.

gsplat's strategy clones, splits and prunes. Each of the three copies all parameters and both of their moments, and
sorting copies them once more. Here the strategy works only on row numbers and on the parameters that it reads. All
other tensors are moved once at the end, by row number, into memory that the gradients have freed. With 110,000
Gaussians this takes a third of the time.
"""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.trainer.row_order import morton_order, sort_rows, take

DECIDING = (
    "means",
    "quats",
    "scales",
    "opacities",
)  # parameters that gsplat reads or changes; it only copies rows of the others
ROWS = "rows"


@torch.no_grad()
def densify(
    strategy: Any,
    splats: nn.ParameterDict,
    optimizers: dict[str, torch.optim.Optimizer],
    strategy_state: dict[str, Any],
    step: int,
    info: dict[str, Any],
    in_order: bool,
) -> None:
    """Densify like `strategy.step_post_backward`, with the same result.

    Parameters whose rows changed become new objects, and new rows get moments of zero, as in gsplat.

    Args:
        strategy: gsplat's DefaultStrategy.
        splats: Parameters by name.
        optimizers: One optimizer per parameter, by the same names.
        strategy_state: Sums of the strategy, changed in place.
        step: Iteration that just ended.
        info: Dictionary of the rasterizer.
        in_order: Sort rows in space afterwards.
    """
    n = len(splats["means"])
    decided = {name: splats[name].detach() for name in DECIDING}
    decided[ROWS] = torch.arange(n, device=splats["means"].device)
    before = {name: nn.Parameter(tensor, requires_grad=False) for name, tensor in decided.items()}
    after: dict[str, Tensor] = dict(before)
    # Stand-ins for optimizers. Their state holds a 1 for each row that keeps its moments.
    ones = {name: torch.ones(n, device=param.device) for name, param in before.items()}
    followers = {
        name: SimpleNamespace(param_groups=[{"params": [param]}], state={param: {"kept": ones[name]}})
        for name, param in before.items()
    }
    packed = info["gaussian_ids"] is not None
    strategy.step_post_backward(after, followers, strategy_state, step, info, packed=packed)
    if all(after[name] is before[name] for name in before):
        if in_order:
            sort_rows(splats, optimizers, strategy_state)
        return
    kept = {name: followers[name].state[param]["kept"] for name, param in after.items()}
    if in_order:
        order = morton_order(after["means"])
        after, kept = ({name: tensor[order] for name, tensor in each.items()} for each in (after, kept))
        for key, value in strategy_state.items():
            if isinstance(value, Tensor):
                strategy_state[key] = value[order]
    rows = after[ROWS].detach()
    for name, param in list(splats.items()):
        splats[name] = nn.Parameter(after[name].detach() if name in after else take(param.detach(), rows))
        fresh = (kept.get(name, kept[ROWS]) == 0.0).nonzero()[:, 0]
        _hand_over(optimizers[name], param, splats[name], rows, fresh)


def _hand_over(optimizer: torch.optim.Optimizer, old: Tensor, new: Tensor, rows: Tensor, fresh: Tensor) -> None:
    """Give an optimizer a new parameter. Its moments are the old ones of `rows`, and 0 for the rows `fresh`."""
    optimizer.param_groups[0]["params"] = [new]
    state = optimizer.state.pop(old, None)
    if state is None:
        return
    for key, moment in state.items():
        if isinstance(moment, Tensor) and moment.shape == old.shape:
            state[key] = take(moment, rows).index_fill_(0, fresh, 0.0)
    optimizer.state[new] = state
