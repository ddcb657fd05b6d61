"""Decisions on the backward pass of an iteration that was not left out."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.decision import Decision
from skipgs_plug.core.ema import ViewMeans
from skipgs_plug.core.pace.refining import Refining
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.state import refinement_policy_state


class RefinementPolicy(Policy):
    """Runs every backward pass, except for watched views, and except after refinement has ended.

    Structural changes need no pause, because running means do not decide.

    Args:
        config: Settings in force.
        refining: The refining phase.
    """

    def __init__(self, config: SkipConfig, refining: Refining) -> None:
        self._config = config
        self._refining = refining
        self._means = ViewMeans(config.ema_decay)

    @property
    def start_iter(self) -> int:
        """First iteration that may be left out."""
        return self._config.start_iter or 0

    def mean(self, view: Hashable) -> float | None:
        """Return the running mean of a view's loss; None for a new view."""
        return self._means.get(view)

    def known_ahead(self, view: Hashable, step: int) -> bool | None:
        """Return True when refinement is over, and False if the view is not watched."""
        if self._refining.over:
            return True
        return None if self._refining.watching and view in self._refining.watched else False

    def decide(self, view: Hashable, loss: float, step: int) -> Decision:
        """Run the backward pass, unless the view is watched or refinement is over. The loss must be finite."""
        self._means.update(view, loss)
        refining = self._refining
        if refining.over:
            return decision.OVER
        if refining.watching and view in refining.watched:
            assert refining.stopping is not None
            refining.stopping.see(str(view), loss)
            return decision.WATCHED
        return decision.FULL

    def notify_event(self, step: int, n_views: int) -> None:
        """Pass the structural change on to the phase."""
        self._refining.notify_event(step, n_views)

    def state_dict(self) -> dict[str, Any]:
        return {"means": self._means.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`.

        Raises:
            SkipGSError: Something is missing from it, or of another type.
        """
        self._means.load_state_dict(refinement_policy_state(state)["means"])
