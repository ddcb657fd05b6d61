"""A look at the model in skipped iterations: nothing may move it there."""

from __future__ import annotations

from collections.abc import Iterable

import torch

from skipgs_plug.core.engine import Engine
from skipgs_plug.core.optimizers import has_pending_gradient

CHECKED_SKIPS = 5  # skipped iterations that are looked at, from the second on


class DriftCheck:
    """Compares the parameters before and after skipped iterations without pending gradients or events.

    What changes them there is something of the loop's own that belongs to the gradient step, such as noise, and
    would go on alone. Sums and norms are compared, which costs two passes over the parameters and no memory.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._left = CHECKED_SKIPS
        # Events so far, and what the parameters were like, when the iteration began.
        self._before: tuple[int, list[tuple[str, list[float]]]] | None = None

    def moved(self, optimizers: Iterable[torch.optim.Optimizer]) -> list[str]:
        """Names of the parameters that the iteration which ends here moved, in an iteration that was skipped.

        To be called once at the beginning of each iteration, before `Hooks.iteration`.
        """
        stats = self._engine.stats
        if self._left == 0 or not stats.skips:
            return []
        optimizers = list(optimizers)
        events = sum(stats.events.values())
        now = None if any(map(has_pending_gradient, optimizers)) else (events, _like(optimizers))
        before, self._before = self._before, now
        if before is None or now is None or not self._engine.skipped or before[0] != events:
            return []
        self._left -= 1
        return [name for (name, old), (_, new) in zip(before[1], now[1], strict=False) if old != new]


def _like(optimizers: list[torch.optim.Optimizer]) -> list[tuple[str, list[float]]]:
    """Name of each parameter group, sums and norms of its parameters."""
    found = []
    for optimizer in optimizers:
        for place, group in enumerate(optimizer.param_groups):
            values = [p.detach() for p in group["params"]]
            sums = [float(function(v)) for v in values for function in (torch.sum, torch.linalg.vector_norm)]
            found.append((str(group.get("name", place)), sums))
    return found
