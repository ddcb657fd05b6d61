"""PyTorch's learning-rate schedulers in loops with left-out iterations: schedulers count calls, not iterations."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingWarmRestarts, LRScheduler, SequentialLR

from skipgs_plug.core.hooks import Hooks

# Classes with a `step` of their own that counts its calls.
COUNTING = (LRScheduler, ChainedScheduler, SequentialLR, CosineAnnealingWarmRestarts)


def catch_up_schedulers(hooks: Hooks, caller: str) -> None:
    """Keep every scheduler that the function `caller` steps at the value it would have if all iterations ran."""
    for kind in COUNTING:
        hooks.catch_up(kind, "step", caller)


def function_names(function: Callable[..., Any]) -> dict[str, Any]:
    """Return the global names of a function under its decorators."""
    return inspect.unwrap(function).__globals__  # type: ignore[attr-defined]
