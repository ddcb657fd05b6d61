"""Control policies that skip as often as the gate did, without reading any loss. Standard library only."""

from __future__ import annotations

import random
from collections.abc import Hashable, Iterable
from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.policy import Policy

RUN = Decision(False, "planned")
SKIP = Decision(True, "planned")


class PlannedSkipping(Policy):
    """Skips exactly the iterations of a plan.

    Args:
        first: First iteration after warm-up. Earlier iterations are never skipped.
        end: Iteration after the last.
        skips: Iterations whose backward pass is left out.
    """

    def __init__(self, first: int, end: int, skips: Iterable[int]) -> None:
        self.first, self.end = first, end
        self.skips = frozenset(skips)

    @property
    def floor(self) -> float:
        """Share of the iterations after warm-up with a backward pass."""
        return 1.0 - len(self.skips) / max(self.end - self.first, 1)

    def decide(self, view: Hashable, loss: float, step: int) -> Decision:
        if step < self.first:
            return decision.WARM_UP
        return SKIP if step in self.skips else RUN

    def notify_event(self, step: int, n_views: int) -> None:
        """Do nothing: a plan does not react to events."""

    def state_dict(self) -> dict[str, Any]:
        return {"first": self.first, "skips": sorted(self.skips)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.first = state["first"]
        self.skips = frozenset(state["skips"])


def random_skipping(first: int, end: int, n_skips: int, seed: int) -> PlannedSkipping:
    """Skip `n_skips` of the iterations first..end-1, every choice equally likely."""
    return PlannedSkipping(first, end, random.Random(seed).sample(range(first, end), n_skips))


def periodic_skipping(first: int, end: int, n_skips: int) -> PlannedSkipping:
    """Skip `n_skips` of the iterations first..end-1, spread as evenly as whole numbers allow (Bresenham)."""
    n = end - first
    return PlannedSkipping(first, end, (first + i for i in range(n) if (i + 1) * n_skips // n > i * n_skips // n))
