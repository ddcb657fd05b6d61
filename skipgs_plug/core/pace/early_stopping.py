"""Estimates how much of refinement a scene needs, with views that are watched but not trained on for a while.

Refinement runs in cycles. In each cycle steps shrink to zero, so that it ends with a finished model. The cycles end
after 1/8, 1/4 and all of the iterations that may run. In the first two, a few views are watched: they are rendered but
not trained on, and their losses at the end of a cycle say how much it improved views outside training. A doubling of
the iterations hardly ever gains more than the doubling before it. So the second cycle's gain, times the number of
doublings that are left, bounds the gain of the rest. If the bound is below the tolerance, refinement ends.

A watched view that gets worse still loses detail that only its own training gave it, which says nothing about other
views. In the last cycle all views are trained. Watched views never recover completely, so they are few and are watched
for a short time only. No view is watched if a twelfth of the views is less than three, or if the first cycle is too
short to show each view.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

from skipgs_plug.core.errors import GateStateError

# Ends of the cycles, as shares of the iterations that may run. Training is judged at the first two ends.
CYCLE_ENDS = (0.125, 0.25, 1.0)
ONE_CYCLE = (1.0,)  # end of the only cycle if nothing is estimated: the share is given, or no view is watched
LEAST_LOSS = 1e-5  # mean absolute difference below which losses count as equal; 8-bit images have steps of 4e-3
WATCHED_FRACTION = 1 / 12  # fraction of the views that is watched: a few, since they never recover completely
# Bounds on the number of watched views. Fewer than three cannot resolve 0.05 dB; more than twelve cost quality.
LEAST_WATCHED, MOST_WATCHED = 3, 12


def watched_views(names: Iterable[str], iterations: float) -> frozenset[str]:
    """Draw the views to watch: the same views for the same names, and no view if there are few.

    Args:
        names: Names of all training views.
        iterations: Number of iterations that may run. No view is watched if the first cycle does not show every view.
    """
    names = sorted(names)
    if why_none_watched(len(names), iterations) is not None:
        return frozenset()
    return frozenset(random.Random(0).sample(names, _watched(len(names))))


def why_none_watched(views: int, iterations: float) -> str | None:
    """Return why no view can be watched, as a clause; None if views can be watched.

    Args:
        views: Number of training views.
        iterations: Number of iterations that may run.
    """
    if _watched(views) < LEAST_WATCHED:
        return f"a twelfth of {views} training views is less than {LEAST_WATCHED} views"
    if CYCLE_ENDS[0] * iterations < views:
        cycle = math.floor(CYCLE_ENDS[0] * iterations)
        return f"the first cycle of {cycle:,} iterations is too short to show each of {views} training views"
    return None


def _watched(views: int) -> int:
    return min(MOST_WATCHED, round(views * WATCHED_FRACTION))


class EarlyStopping:
    """Follows the cycles, and ends refinement when the rest would gain too little.

    Args:
        tolerance: Gain of the rest, in decibels, below which refinement ends.
        ends: Ends of the cycles, as shares of the iterations that may run.

    Attributes:
        cycle: Index of the present cycle.
        ended: Whether refinement is over.
        gains: Gain of the watched views in each judged cycle, in decibels: (mean, standard error).
        gain_left: Bound on the gain of the rest at the last check, in decibels, two standard errors included.
    """

    def __init__(self, tolerance: float, ends: tuple[float, ...] = CYCLE_ENDS) -> None:
        self._tolerance, self._ends = tolerance, ends
        self.cycle = 0
        self.ended = False
        self.gains: list[tuple[float, float]] = []
        self.gain_left: float | None = None
        self._now: dict[str, float] = {}
        self._before: dict[str, float] = {}

    @property
    def watching(self) -> bool:
        """Whether watched views are left out of training at present."""
        return not self.ended and self.cycle < len(self._ends) - 1

    @property
    def early(self) -> bool:
        """Whether refinement ended before all iterations that may run had run."""
        return self.ended and self.cycle < len(self._ends) - 1

    def see(self, view: str, loss: float) -> None:
        """Record the loss of a watched view; its last loss in a cycle counts.

        Args:
            view: Key of the view.
            loss: Its loss. A loss of 0 or below does not count.
        """
        if loss > 0.0:
            self._now[view] = loss

    def progress(self, share_done: float) -> float:
        """Return the progress through the present cycle, in [0, 1]; judge each cycle that has ended.

        Args:
            share_done: Share of the iterations that may run that have run, in [0, 1].
        """
        while not self.ended and share_done >= self._ends[self.cycle]:
            self._end_cycle()
        if self.ended:
            return 1.0
        begin = self._ends[self.cycle - 1] if self.cycle else 0.0
        return (share_done - begin) / (self._ends[self.cycle] - begin)

    def _end_cycle(self) -> None:
        end = self._ends[self.cycle]
        if end == 1.0:
            self.ended = True
            return
        # The first cycle is not judged: watched views first lose detail that only their own training gave them.
        if self.cycle > 0:
            gain = mean_gain(self._before, self._now)
            if gain is not None:
                self.gains.append(gain)
                mean, error = gain
                self.gain_left = (abs(mean) + 2.0 * error) * math.log2(1.0 / end)
                self.ended = self.gain_left < self._tolerance
                if self.ended:
                    return
        self._before = {**self._before, **self._now}
        self._now = {}
        self.cycle += 1

    def state_dict(self) -> dict[str, Any]:
        return {
            "ends": list(self._ends),
            "cycle": self.cycle,
            "ended": self.ended,
            "gains": [list(gain) for gain in self.gains],
            "foreseen": self.gain_left,
            "now": dict(self._now),
            "before": dict(self._before),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`.

        Raises:
            SkipGSError: No run has such cycles.
        """
        if tuple(state["ends"]) not in (CYCLE_ENDS, ONE_CYCLE) or not 0 <= state["cycle"] < len(state["ends"]):
            raise GateStateError(
                f"The gate state is in cycle {state['cycle']} of cycles that end at {state['ends']}, which no run has; "
                "start the gate afresh."
            )
        self._ends = tuple(state["ends"])
        self.cycle, self.ended, self.gain_left = int(state["cycle"]), bool(state["ended"]), state["foreseen"]
        self.gains = [(float(mean), float(error)) for mean, error in state["gains"]]
        self._now, self._before = dict(state["now"]), dict(state["before"])


def mean_gain(before: dict[str, float], after: dict[str, float]) -> tuple[float, float] | None:
    """Return the mean and the standard error of the gain, in decibels; None with fewer than two views.

    Losses of 3DGS are mostly mean absolute differences, so 20 log10 of their ratio is about the gain in PSNR.

    Args:
        before: Losses of views at the end of an earlier cycle.
        after: Losses of views at the end of a later cycle. Views in only one of the two do not count.
    """
    # A view that shows background only has a loss of 0.
    pairs = [(max(before[view], LEAST_LOSS), max(after[view], LEAST_LOSS)) for view in sorted(after) if view in before]
    gains = [20.0 * math.log10(earlier / later) for earlier, later in pairs]
    if len(gains) < 2:
        return None
    mean = math.fsum(gains) / len(gains)
    variance = math.fsum((gain - mean) ** 2 for gain in gains) / (len(gains) - 1)
    return mean, math.sqrt(variance / len(gains))
