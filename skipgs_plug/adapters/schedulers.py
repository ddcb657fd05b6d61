"""PyTorch's learning-rate schedulers in loops that leave out iterations: they count calls, not numbers."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingWarmRestarts, LRScheduler, SequentialLR

from skipgs_plug.core.hooks import Hooks

# Those with a `step` of their own that counts its calls.
COUNTING = (LRScheduler, ChainedScheduler, SequentialLR, CosineAnnealingWarmRestarts)


def catch_up_schedulers(hooks: Hooks, caller: str) -> None:
    """Let every scheduler that the function `caller` steps be where it would be if all iterations ran."""
    for kind in COUNTING:
        hooks.catch_up(kind, "step", caller)


def function_names(function: Callable[..., Any]) -> dict[str, Any]:
    """Global names of a function, looking through what it is wrapped in."""
    return inspect.unwrap(function).__globals__  # type: ignore[attr-defined]
