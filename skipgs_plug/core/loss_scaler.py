"""`torch.amp.GradScaler` in iterations without gradients, in which its methods fail."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import torch

from skipgs_plug.core.gated_iteration import GatedIteration
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.optimizers import has_pending_gradient


def guard_scalers(patches: Patches, now: GatedIteration) -> None:
    """Let scalers use only gradients that exist, in iterations whose backward pass was skipped.

    `unscale_` and `step` then do nothing for an optimizer without gradients. `update` does nothing if none stepped.

    Args:
        patches: List of replacements, to which the methods of the class are added.
        now: The present iteration.
    """
    stepped: weakref.WeakSet[torch.amp.GradScaler] = weakref.WeakSet()

    def has_work(scaler: torch.amp.GradScaler, optimizer: torch.optim.Optimizer) -> bool:
        return not (now.skipped and scaler.is_enabled()) or has_pending_gradient(optimizer)

    def unscale(original: Callable[..., Any], scaler: torch.amp.GradScaler, optimizer: torch.optim.Optimizer) -> None:
        if has_work(scaler, optimizer):
            original(scaler, optimizer)

    def step(
        original: Callable[..., Any],
        scaler: torch.amp.GradScaler,
        optimizer: torch.optim.Optimizer,
        *args: Any,
        **kwargs: Any,
    ) -> Any:
        if not has_work(scaler, optimizer):
            return None
        stepped.add(scaler)
        return original(scaler, optimizer, *args, **kwargs)

    def update(original: Callable[..., Any], scaler: torch.amp.GradScaler, *args: Any, **kwargs: Any) -> None:
        if not now.skipped or scaler in stepped:
            original(scaler, *args, **kwargs)
        stepped.discard(scaler)

    patches.wrap(torch.amp.GradScaler, "unscale_", unscale)
    patches.wrap(torch.amp.GradScaler, "step", step)
    patches.wrap(torch.amp.GradScaler, "update", update)
