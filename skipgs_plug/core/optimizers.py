"""Helpers for the optimizers of a gated loop."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch

Named = Callable[[], Mapping[str, torch.optim.Optimizer]]
Optimizers = Named | Callable[[], Iterable[torch.optim.Optimizer]]


def has_pending_gradient(optimizer: torch.optim.Optimizer) -> bool:
    """Whether a parameter of the optimizer has a gradient."""
    for group in optimizer.param_groups:  # a loop takes half of the time that `any` takes
        for parameter in group["params"]:
            if parameter.grad is not None:
                return True
    return False


def held_by(owner: Any) -> list[torch.optim.Optimizer]:
    """Return the optimizers that are attributes of an object."""
    return [one for one in vars(owner).values() if isinstance(one, torch.optim.Optimizer)]


def listed(optimizer: Any) -> list[torch.optim.Optimizer]:
    """Return the optimizers as a list, given one optimizer or a list, tuple or mapping of optimizers."""
    if isinstance(optimizer, Mapping):
        return list(optimizer.values())
    if isinstance(optimizer, (list, tuple)):
        return list(optimizer)
    return [optimizer]


def with_names(
    optimizers: Mapping[str, torch.optim.Optimizer] | Iterable[torch.optim.Optimizer],
) -> list[tuple[str | None, torch.optim.Optimizer]]:
    """Return each optimizer with its name; None without names."""
    return list(optimizers.items()) if isinstance(optimizers, Mapping) else [(None, one) for one in optimizers]
