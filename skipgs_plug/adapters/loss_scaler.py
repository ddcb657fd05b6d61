"""`torch.amp.GradScaler` in iterations without gradients, in which its methods fail."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.optimizers import has_pending_gradient


def guard_scaler(hooks: Hooks, scaler: torch.amp.GradScaler) -> None:
    """In skipped iterations, call `unscale_` and `update` only for gradients that are left from earlier iterations."""
    if not scaler.is_enabled():
        return
    stepped: list[bool] = []

    def unscale(original: Callable[..., Any], optimizer: torch.optim.Optimizer) -> None:
        if not hooks.state.skipped or has_pending_gradient(optimizer):
            original(optimizer)

    def update(original: Callable[..., Any], *args: Any, **kwargs: Any) -> None:
        if not hooks.state.skipped or stepped:
            original(*args, **kwargs)
        stepped.clear()

    hooks.wrap(scaler, "unscale_", unscale)
    hooks.before(scaler, "step", lambda *args, **kwargs: stepped.append(True))
    hooks.wrap(scaler, "update", update)
