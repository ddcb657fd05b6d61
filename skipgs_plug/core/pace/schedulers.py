"""Keeps PyTorch's learning-rate schedulers in step: they count calls, which left-out iterations do not make."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from typing import Any

from torch.optim.lr_scheduler import ChainedScheduler, CosineAnnealingWarmRestarts, LRScheduler, SequentialLR

from skipgs_plug.core.intercept import Patches
from skipgs_plug.core.pace.base import Pace

# Classes with a `step` of their own that counts its calls.
COUNTING = (LRScheduler, ChainedScheduler, SequentialLR, CosineAnnealingWarmRestarts)


def catch_up_schedulers(patches: Patches, pace: Pace) -> None:
    """Keep every scheduler that the training loop steps where it would be if all iterations ran.

    Args:
        patches: List of replacements, to which `step` of the schedulers is added.
        pace: Leaves out iterations.
    """
    known: weakref.WeakKeyDictionary[Any, _Steps] = weakref.WeakKeyDictionary()
    under_way: list[Any] = []  # a scheduler that is made of others steps them itself

    def caught_up(original: Callable[..., Any], scheduler: Any, *args: Any, **kwargs: Any) -> Any:
        number = pace.number
        if under_way or number is None:
            return original(scheduler, *args, **kwargs)
        under_way.append(scheduler)
        try:
            for _ in range(known.setdefault(scheduler, _Steps()).missing(pace, number)):
                original(scheduler, *args, **kwargs)
            return original(scheduler, *args, **kwargs)
        finally:
            under_way.clear()

    for kind in COUNTING:
        patches.wrap(kind, "step", caught_up)


class _Steps:
    """The steps that one scheduler lacks because iterations were left out.

    A scheduler steps in every iteration if it steps in one that no condition of the loop names. Until then it may step
    in every hundredth iteration, for example. Such a scheduler lacks no step, because its iterations are not left out.
    """

    def __init__(self) -> None:
        self._in_every_iteration = False
        self._left_out = 0

    def missing(self, pace: Pace, number: int) -> int:
        """Return the number of steps that are missing before the step in iteration `number`, the present one."""
        self._left_out += pace.gap
        self._in_every_iteration = self._in_every_iteration or not pace.is_named(number)
        if not self._in_every_iteration:
            return 0
        missing, self._left_out = self._left_out, 0
        return missing
