"""`torch.amp.GradScaler` in gated loops: it scales the loss, and it fails in iterations without gradients."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.core.gated_iteration import GatedIteration
from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.optimizers import has_pending_gradient

_UNSCALED = "_skipgs_unscaled"  # attribute of a scaled loss: its value before


def guard_scalers(patches: Patches, now: GatedIteration) -> None:
    """Let scalers use only gradients that exist, in iterations whose backward pass was skipped.

    `unscale_` and `step` then do nothing for an optimizer without gradients, and neither does `update` after them.
    `scale` notes the loss before it; see `unscaled`. The methods of the class are replaced once for all gates, and put
    back when the last gate is detached or dropped.

    Args:
        patches: List of replacements, which undoes this one too.
        now: The present iteration of a gate.
    """
    _guarded.add(now)  # first, because a gate that is dropped meanwhile puts the methods back if it is the last one
    dropped = weakref.finalize(now, _restore_after_last)
    dropped.atexit = False
    if not _replaced.names:
        for around in (scale, unscale_, step, update):
            _replaced.wrap(torch.amp.GradScaler, around.__name__, around)
    own = weakref.ref(now)

    def undo() -> None:
        if (iteration := own()) is not None:
            _guarded.discard(iteration)
        dropped()

    for name in _replaced.names:
        patches.add_undo(name, undo)


def unscaled(number: Any) -> Any:
    """Return the value that a loss had before a scaler multiplied it, on its device; any other number as it is.

    Means of scaled losses would be wrong by a factor whenever the scale changes. A scaled loss may also be infinite
    where the loss is not; the scaler then lowers its scale, for which it needs the backward pass.
    """
    return getattr(number, _UNSCALED, number)


def scale(original: Callable[..., Any], scaler: torch.amp.GradScaler, outputs: Any) -> Any:
    scaled = original(scaler, outputs)
    batch = isinstance(outputs, (list, tuple))
    for loss, multiplied in zip(outputs, scaled, strict=True) if batch else [(outputs, scaled)]:
        if isinstance(loss, Tensor) and multiplied is not loss:
            setattr(multiplied, _UNSCALED, loss.detach())
    return scaled


def unscale_(original: Callable[..., Any], scaler: torch.amp.GradScaler, optimizer: torch.optim.Optimizer) -> None:
    if _has_work(scaler, optimizer):
        _used.add(scaler)
        original(scaler, optimizer)


def step(
    original: Callable[..., Any],
    scaler: torch.amp.GradScaler,
    optimizer: torch.optim.Optimizer,
    *args: Any,
    **kwargs: Any,
) -> Any:
    if not _has_work(scaler, optimizer):
        return None
    _used.add(scaler)
    return original(scaler, optimizer, *args, **kwargs)


def update(original: Callable[..., Any], scaler: torch.amp.GradScaler, *args: Any, **kwargs: Any) -> None:
    if scaler in _used or not _skipped():
        original(scaler, *args, **kwargs)
    _used.discard(scaler)


def _has_work(scaler: torch.amp.GradScaler, optimizer: torch.optim.Optimizer) -> bool:
    return not (_skipped() and scaler.is_enabled()) or has_pending_gradient(optimizer)


def _skipped() -> bool:
    return any(now.skipped for now in _guarded)


def _restore_after_last() -> None:
    if not any(True for _ in _guarded):  # `len` may still count a gate that is being dropped
        _replaced.restore()


_guarded: weakref.WeakSet[GatedIteration] = weakref.WeakSet()  # present iterations of the gates with guarded scalers
_used: weakref.WeakSet[torch.amp.GradScaler] = weakref.WeakSet()  # scalers that had gradients since their last update
_replaced = Patches(on_error=lambda error: None)  # after an error here, the scaler does its work as without a gate
