"""Optimizer steps of a gated loop: only with a pending gradient."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def has_pending_gradient(optimizer: torch.optim.Optimizer) -> bool:
    """Whether some parameter of the optimizer has a gradient that no step has used yet."""
    return any(p.grad is not None for group in optimizer.param_groups for p in group["params"])


def listed(optimizer: Any) -> list[torch.optim.Optimizer]:
    """Return one optimizer, a collection or a dict of them as a list."""
    if isinstance(optimizer, Mapping):
        return list(optimizer.values())
    if isinstance(optimizer, (list, tuple)):
        return list(optimizer)
    return [optimizer]
