"""Statistics of a gate: counts, per-view table, scalars for loggers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skipgs_plug.core.decision import Decision
from skipgs_plug.core.views import forget_oldest


class GateStats:
    """Counts of decisions. Every gated iteration is either a backward or a skip.

    Attributes:
        iterations: Number of training backward passes, run or skipped, before `start_iter` too.
        backwards: Number of real backward passes from `start_iter` on, including those in warm-up and in pauses.
        skips: Number of skipped backward passes.
        reasons: Number of gated decisions, by reason.
        changes: Number of structural changes that the policy was notified of, by kind.
    """

    def __init__(self) -> None:
        self.iterations = 0
        self.backwards = 0
        self.skips = 0
        self.reasons: dict[str, int] = {}
        self.changes: dict[str, int] = {}
        self._views: dict[str, list[Any]] = {}  # visits, backwards, skips, last loss

    def record(self, decision: Decision, view: str, loss: float | None) -> bool:
        """Count one gated decision; return True for a new view. The loss is None if it was not read."""
        self.reasons[decision.reason] = self.reasons.get(decision.reason, 0) + 1
        row = self._views.get(view)
        new = row is None
        if row is None:
            row = self._views[view] = [0, 0, 0, 0.0 if loss is None else loss]
            forget_oldest(self._views)
        row[0] += 1
        if loss is not None:
            row[3] = loss
        if decision.skip:
            self.skips += 1
            row[2] += 1
        else:
            self.backwards += 1
            row[1] += 1
        return new

    @property
    def gated(self) -> int:
        """Number of training backward passes from `start_iter` on, run or skipped."""
        return self.backwards + self.skips

    @property
    def skip_ratio(self) -> float:
        """Share of the gated backward passes that were skipped; 0 if there was none."""
        return self.skips / self.gated if self.gated else 0.0

    @property
    def n_views(self) -> int:
        """Number of different views since `start_iter`, at most MAX_VIEWS."""
        return len(self._views)

    def view_table(self, mean_of: Callable[[str], float | None]) -> list[dict[str, Any]]:
        """Return one row per view, by name: `view visits backwards skips mean_loss last_loss`."""
        return [
            {
                "view": view,
                "visits": row[0],
                "backwards": row[1],
                "skips": row[2],
                "mean_loss": mean_of(view),
                "last_loss": row[3],
            }
            for view, row in sorted(self._views.items())
        ]

    def scalars(self) -> dict[str, float]:
        """Return the counts as a flat dict for loggers."""
        return {
            "skipgs/skip_ratio": self.skip_ratio,
            "skipgs/backwards": float(self.backwards),
            "skipgs/skips": float(self.skips),
            "skipgs/paused": float(self.reasons.get("pause", 0)),
            "skipgs/non_finite": float(self.reasons.get("non-finite", 0)),
        }

    def load_release_state(self, state: dict[str, Any]) -> None:
        """Load the counts of the authors' controller, which has no counts per view."""
        self.backwards, self.skips = state["stats"]["bwd"], state["stats"]["skip"]
        self.iterations = self.gated

    def state_dict(self) -> dict[str, Any]:
        return {
            "iterations": self.iterations,
            "backwards": self.backwards,
            "skips": self.skips,
            "reasons": dict(self.reasons),
            "events": dict(self.changes),
            "views": {view: list(row) for view, row in list(self._views.items())},  # another thread may train meanwhile
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.iterations = state["iterations"]
        self.backwards = state["backwards"]
        self.skips = state["skips"]
        self.reasons = dict(state["reasons"])
        self.changes = dict(state["events"])
        self._views = {view: list(row) for view, row in state["views"].items()}
