"""How much of refinement a scene needs, foreseen from views that are watched but not trained on for a while.

Refinement runs in cycles of steps that shrink to nothing, so that a cycle leaves a finished model behind; they end at
1/8, 1/4 and all of what may run. In the first two, the losses of a few watched views at the end of a cycle say what it
brought to views that are not trained on. What a doubling of the iterations brings hardly ever grows with the next
doubling, so the second cycle's gain times the doublings that are left bounds what the rest would still bring; when
that is less than the tolerance, refinement ends. Watched views that get worse still lose what only training gave them,
which says nothing of the others. In the last cycle all views are trained. Watched views never get back wholly what
they missed, so there are few, not for long, and none where a twelfth of the views is less than three or where a cycle
is too short to show each of them.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterable
from typing import Any

from skipgs_plug.core.errors import SkipGSError

CYCLE_ENDS = (0.125, 0.25, 1.0)
ONE_CYCLE = (1.0,)  # where nothing is to be foreseen: the share is given, or no view is watched
LEAST_LOSS = 1e-5  # below, no picture differs
WATCHED_SHARE = 1 / 12  # of the views
LEAST_WATCHED, MOST_WATCHED = 3, 12  # fewer than three cannot tell a twentieth of a decibel: none then


def watched_views(names: Iterable[str], iterations: float, seed: int = 0) -> frozenset[str]:
    """Draw the views to watch; the same for the same names, none where there are few views.

    Args:
        names: Of all training views.
        iterations: That may run. None is watched where the first cycle does not show every view.
        seed: Of the draw.
    """
    names = sorted(names)
    count = min(MOST_WATCHED, round(len(names) * WATCHED_SHARE))
    if count < LEAST_WATCHED or CYCLE_ENDS[0] * iterations < len(names):
        return frozenset()
    return frozenset(random.Random(seed).sample(names, count))


class EarlyStopping:
    """Follows the cycles, and says when the rest is not worth its time.

    Args:
        tolerance: Decibels that the rest may be worth when refinement ends.
        ends: Where cycles end, as shares of the iterations that may run.

    Attributes:
        cycle: index of the present cycle.
        ended: refinement is over.
        gains: decibels that each finished cycle brought to the watched views: (mean, standard error).
        foreseen: decibels that the rest was worth when it was last judged, with two standard errors added.
    """

    def __init__(self, tolerance: float, ends: tuple[float, ...] = CYCLE_ENDS) -> None:
        self._tolerance, self._ends = tolerance, ends
        self.cycle = 0
        self.ended = False
        self.gains: list[tuple[float, float]] = []
        self.foreseen: float | None = None
        self._now: dict[str, float] = {}
        self._before: dict[str, float] = {}

    @property
    def watching(self) -> bool:
        """Whether watched views are left out of training at present."""
        return not self.ended and self.cycle < len(self._ends) - 1

    @property
    def early(self) -> bool:
        """Whether refinement ended before all that may run has run."""
        return self.ended and self.cycle < len(self._ends) - 1

    def see(self, view: str, loss: float) -> None:
        """A watched view was rendered; its last loss in a cycle counts."""
        if loss > 0.0:
            self._now[view] = loss

    def progress(self, share_done: float) -> float:
        """Return the progress through the present cycle, having gone some share of the way; judges where one ends.

        Args:
            share_done: Iterations run, of those that may run, in [0, 1].
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
        # The first cycle is not judged: views that are no longer trained on lose what only training gave them.
        if self.cycle > 0:
            gain = mean_gain(self._before, self._now)
            if gain is not None:
                self.gains.append(gain)
                mean, error = gain
                self.foreseen = (abs(mean) + 2.0 * error) * math.log2(1.0 / end)
                self.ended = self.foreseen < self._tolerance
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
            "foreseen": self.foreseen,
            "now": dict(self._now),
            "before": dict(self._before),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict()`.

        Raises:
            SkipGSError: Its cycles are none.
        """
        if tuple(state["ends"]) not in (CYCLE_ENDS, ONE_CYCLE) or not 0 <= state["cycle"] < len(state["ends"]):
            raise SkipGSError(
                f"The gate state is in cycle {state['cycle']} of those that end at {state['ends']}, which no run has; "
                "start the gate afresh."
            )
        self._ends = tuple(state["ends"])
        self.cycle, self.ended, self.foreseen = int(state["cycle"]), bool(state["ended"]), state["foreseen"]
        self.gains = [(float(mean), float(error)) for mean, error in state["gains"]]
        self._now, self._before = dict(state["now"]), dict(state["before"])


def mean_gain(before: dict[str, float], after: dict[str, float]) -> tuple[float, float] | None:
    """Return mean and standard error of the gain over the views seen both times, in decibels; None with less than two.

    Losses of 3DGS are mean absolute differences for the most part, so 20 log10 of their ratio is about what PSNR gains.
    """
    # A view of background alone has a loss of 0.
    pairs = [(max(before[view], LEAST_LOSS), max(after[view], LEAST_LOSS)) for view in sorted(after) if view in before]
    gains = [20.0 * math.log10(earlier / later) for earlier, later in pairs]
    if len(gains) < 2:
        return None
    mean = math.fsum(gains) / len(gains)
    variance = math.fsum((gain - mean) ** 2 for gain in gains) / (len(gains) - 1)
    return mean, math.sqrt(variance / len(gains))
