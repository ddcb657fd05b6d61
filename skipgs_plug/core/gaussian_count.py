"""Notice that Gaussians were added or removed by code that an adapter does not know."""

from __future__ import annotations

import torch

from skipgs_plug.core.optimizers import Optimizers, with_names
from skipgs_plug.core.stats import GateStats


class GaussianCount:
    """Compares the shapes of the parameters at the beginnings of iterations.

    Args:
        stats: Counts of the gate, with the structural changes that were reported.
        optimizers: Returns the optimizers of the parameters.
    """

    def __init__(self, stats: GateStats, optimizers: Optimizers) -> None:
        self._stats, self._optimizers = stats, optimizers
        self._reported = 0  # structural changes when the iteration began
        self._shapes: list[torch.Size] | None = None  # None before the first iteration

    def changed(self) -> bool:
        """Whether the number changed in the iteration before this call, and nothing reported a structural change.

        Call it once at the beginning of each iteration.
        """
        shapes = [
            param.shape
            for _, one in with_names(self._optimizers())
            for group in one.param_groups
            for param in group["params"]
        ]
        reported = sum(self._stats.changes.values())
        differs = self._shapes not in (None, shapes) and reported == self._reported
        self._shapes, self._reported = shapes, reported
        return differs
