"""Recovery from structural changes that come when refinement has ended, or when its steps are small."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

# Largest number of iterations that run after a structural change that comes when refinement has ended, if one visit of
# each view takes no more. It is as long as the gate's pause (`pause.MIN_PAUSE_ITERS`).
LONGEST = 500


class Recovery:
    """Lets iterations run after a structural change, such as a prune, so that the model recovers.

    A change among the last steps of refinement, which are small, is recovered from after refinement.

    The distance to the following change is expected to be that to the previous one. Until then the share of the
    iterations runs, so that a trainer that prunes again and again still leaves out most iterations. After the last
    change, or if no change comes as expected, all iterations run, up to `LONGEST` or one visit of each view. With the
    share alone, five prunes cost Speedy-Splat 1.1 dB (benchmarks/notes/EVIDENCE.md).
    """

    def __init__(self) -> None:
        self._length = self._done = 0  # number of iterations to run after a change, and number that ran
        self._changed: int | None = None  # iteration of the last change
        self._most = LONGEST  # largest number of iterations that run after it
        self._expected: int | None = None  # iteration in which another change is expected; None if no change is
        # Number of iterations that had run at the last change before refinement ended, and number that should follow.
        self._before_change = self._after_change = 0

    @property
    def goes_on(self) -> bool:
        """Whether iterations run for the recovery at present."""
        return self._done < self._length

    @property
    def factor(self) -> float:
        """Factor on learning rates meanwhile, which falls from 1 to 0."""
        return 1.0 - self._done / self._length

    def count(self) -> None:
        """Count an iteration that runs for the recovery."""
        self._done += 1

    def _begin(self, iterations: int) -> None:
        self._length, self._done = iterations, 0

    def change(
        self, step: int, last: int, share: float, n_views: int, pause: int | None, ran: int, ended: bool
    ) -> None:
        """Take note of a structural change.

        Args:
            step: Iteration of the change.
            last: Last iteration of the run.
            share: Share of the iterations of refinement that runs.
            n_views: Number of training views; the model recovers for at least one visit of each.
            pause: Number of iterations after each change that the user gave; None to choose it.
            ran: Number of iterations of refinement that ran.
            ended: Whether refinement has ended.
        """
        before, self._changed = self._changed, step
        if step == before:
            return
        self._most, self._expected = max(n_views, LONGEST), None
        if pause is not None:
            iterations = pause
        elif before is None or last - step <= step - before:
            iterations = min(self._most, last - step)
        else:
            self._expected = 2 * step - before
            iterations = min(self._most, max(n_views, math.ceil(share * (step - before))))
        if ended:
            self._begin(iterations)
        else:
            self._before_change, self._after_change = ran, iterations

    def arrive(self, number: int, last: int, ended: bool) -> None:
        """Take note of the present iteration: a change that was expected before it has not come.

        Args:
            number: The iteration.
            last: Last iteration of the run.
            ended: Whether refinement has ended.
        """
        if self._expected is None or number <= self._expected:
            return
        if ended:
            self._begin(min(self._most, last - self._expected))
        self._expected = None

    def after_refinement(self, ran: int, last: int) -> None:
        """Let iterations run now that refinement has ended, if a change in the second half of its steps got too few.

        An opacity reset after five sixths of the steps cost FSGS's script 4 dB on fern. Unless another change is
        expected, they are the last iterations of the schedule: what runs after a later change counts for both.

        Args:
            ran: Number of iterations of refinement that ran.
            last: Last iteration of the run.
        """
        missing = self._after_change - (ran - self._before_change)
        if missing > 0 and ran < 2 * self._before_change:
            if self._expected is None:
                self._expected = last - missing
            else:
                self._begin(missing)
        self._after_change = 0

    def state_dict(self) -> dict[str, Any]:
        """Return the entries of `Refining.state_dict()` about recovery."""
        return {
            "recovery": [self._length, self._done],
            "changed": self._changed,
            "expected": self._expected,
            "most": self._most,
            "late_change": [self._before_change, self._after_change],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from `state_dict()`. States of earlier versions have the first entry alone."""
        self._length, self._done = state["recovery"]
        self._changed, self._expected = state.get("changed"), state.get("expected")
        self._most = state.get("most", LONGEST)
        self._before_change, self._after_change = state.get("late_change", (0, 0))
