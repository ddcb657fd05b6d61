"""Densification events: which of them run when iterations of the growing phase are left out."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Mapping
from typing import Any

from skipgs_plug.core.pace.needs import LEAST_GROWING_SHARE
from skipgs_plug.core.pace.visibility import VISIBLE
from skipgs_plug.core.trainer_info import Densification

# Number of iterations that a densification event needs if a view shows almost none of the Gaussians. It needs fewer if
# a view shows more: this number times (1 - visible) to the power `POWER_OF_HIDDEN`. A run of fewer iterations is less
# far at each event than the trainer's own, so more gradients exceed the threshold. With every event kept, a tenth of
# 15,000 iterations ends with 170 % of the Gaussians on bonsai, where a view shows a third of them, and with 190 % on a
# ray-traced scene, where it shows three quarters. Where it shows nearly all, as on Lego and fern, the number of events
# limits growth: with every second event they end with half to three quarters. The two numbers are fitted: for as many
# Gaussians as in the own run, bonsai needs about 47 iterations per event, the ray-traced scene 32, fern at most 40 and
# Lego at most 10.
STEPS_BEHIND = 55.0
POWER_OF_HIDDEN = 0.4
# A larger share than a tenth has more iterations between two events, which would all run otherwise: on the ray-traced
# scene they end with 106 % of the Gaussians with a tenth of 15,000 iterations, but with 118 % with a quarter of 3,000.
# So an event needs more, by a power of the share: this number times the square of the share that a view shows. Where a
# view shows a third of the Gaussians, as on bonsai, their number is right without this factor, and with a power of 1/3
# images of 798x531 pixels end 0.2 dB lower.
POWER_OF_SHARE = 0.5
# Least number of events that run in a shortened phase, even if they need more iterations. A schedule with fewer events
# keeps all of them. An event at most doubles the number of Gaussians. With 7 or 8 of 13 events, scripts on bonsai at
# 100x67 ended with half of their Gaussians and 0.011 less SSIM.
LEAST_EVENTS = 16


def sort_conditions(
    conditions: Mapping[str, set[int]], numbers: range, densification: Densification
) -> tuple[set[int], set[int], dict[str, set[int]]]:
    """Return the iterations with a densification event, those with an opacity reset, and all but events by condition.

    Args:
        conditions: Iterations that conditions of the loop name, by condition.
        numbers: Iterations of the phase, for a strategy object that decides by itself.
        densification: How to recognise both.
    """
    events = set() if densification.numbers is None else set(densification.numbers(numbers))
    resets = set() if densification.reset_numbers is None else set(densification.reset_numbers(numbers))
    others: dict[str, set[int]] = {}
    for condition, hits in conditions.items():
        if any(mark in condition for mark in densification.reset_marks):
            resets |= hits
        if any(mark in condition for mark in densification.marks):
            events |= hits
        elif hits:
            others[condition] = hits
    return events, resets, others


class DensificationEvents:
    """Decides for each event whether enough iterations ran before it.

    If an event is left out, its statistics go on to the following event.

    Args:
        numbers: Iterations with an event.
        densification: The needs of this trainer's events.

    Attributes:
        resets: Whether opacities are reset now and then, or it is not known.
        clears_moments: Whether events clear Adam's moments of opacities; see `Densification`.
        kept, left_out: Numbers of events so far.
        rows: Number of Gaussians now; 0 if it is not known. The caller sets it.
    """

    def __init__(self, numbers: Iterable[int], densification: Densification) -> None:
        self._numbers = sorted(numbers)
        self._known = frozenset(self._numbers)
        self._needs = densification.needs
        self.resets, self.clears_moments = densification.resets, densification.clears_moments
        self._resets_known = densification.reset_numbers is not None or bool(densification.reset_marks)
        self.kept = self.left_out = 0
        self._behind = 0  # number of iterations that ran since the last event, and of surplus ones before it
        self.rows = self._rows_before = 0  # now, and before the last event that ran

    def __contains__(self, number: int) -> bool:
        return number in self._known

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def end(self) -> int | None:
        """Iteration of the event that would follow the last one in the trainer's schedule; None without events."""
        return self._numbers[-1] + self._distance(self._numbers[-1]) if self._numbers else None

    def with_resets(self, found: bool, stop: int) -> bool:
        """Whether steps must be as in a phase with opacity resets.

        Two kinds of trainers without resets would end with too many Gaussians. If Gaussians are selected by importance
        long after the last event, Mini-Splatting has 145 instead of 119 % of its own run's on fern. If events clear
        moments, FastGS has 123 instead of 119 % on bonsai, with .005 less SSIM.

        Args:
            found: Whether a reset in the phase is known.
            stop: First iteration after the phase.
        """
        selects = self.end is not None and stop > self.end + self._distance(self._numbers[-1])
        return self.resets and (found or not self._resets_known or self.clears_moments or selects)

    @property
    def all_run(self) -> bool:
        """Whether each event runs, however few iterations ran before it."""
        return self._needs == "nothing"

    @property
    def behind(self) -> int:
        """Number of iterations that add to the statistics of an event in the present iteration, this one included."""
        return self._behind + 1

    def ran(self, number: int, needed: int = 0) -> None:
        """Count an iteration that runs, with its event if it has one.

        Args:
            number: The iteration.
            needed: Number of iterations that the event needed. The following event can count as many surplus ones.
        """
        if number in self._known:
            self.kept += 1
            # Without a surplus, 40 iterations per event would be as good as 25 if 50 are needed: every second event.
            self._behind = min(max(self.behind - needed, 0), needed) if self._needs == "visits" else 0
            self._rows_before = self.rows
        else:
            self._behind += 1

    def skipped(self) -> None:
        """Count an event that is left out."""
        self.left_out += 1

    @property
    def grown(self) -> int:
        """Number of Gaussians that the last event added; 0 if it is not known, or if prunes and resets removed more."""
        return max(self.rows - self._rows_before, 0) if self._rows_before else 0

    @property
    def growth(self) -> float:
        """Number of Gaussians that the last event added, as a share of those before it."""
        return self.grown / self._rows_before if self._rows_before else 0.0

    def needed(
        self, number: int, visible: float | None, share: float, length: int, grows_strongly: bool = False
    ) -> int:
        """Return the number of iterations that the event in iteration `number` needs; compare with `behind`.

        Args:
            number: Iteration with an event.
            visible: Share of the Gaussians that a view shows; None if unknown.
            share: Share of the iterations that runs, in (0, 1].
            length: Number of iterations of the phase, left-out ones included.
            grows_strongly: Whether the scene has many new Gaussians. A larger share asks for no more iterations then.
        """
        if self.all_run or share >= 1.0:
            return 0
        distance = self._distance(number)
        if self._needs == "iterations":
            return distance
        visible = visible or VISIBLE
        needed = STEPS_BEHIND * (1.0 - visible) ** POWER_OF_HIDDEN
        if not grows_strongly:
            needed *= (share / LEAST_GROWING_SHARE) ** (POWER_OF_SHARE * visible**2)
        return min(int(needed), math.ceil(share * length / LEAST_EVENTS), distance)

    def _distance(self, number: int) -> int:
        """Return the number of iterations from the previous event to this one in the trainer's own schedule."""
        index = bisect.bisect_left(self._numbers, number)
        before = self._numbers[index - 1] if index else 0
        return number - before

    def state_dict(self) -> dict[str, Any]:
        rows = [self._rows_before, self.rows]
        return {"kept": self.kept, "left_out": self.left_out, "behind": self._behind, "gaussians": rows}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.kept, self.left_out, self._behind = int(state["kept"]), int(state["left_out"]), int(state["behind"])
        self._rows_before, self.rows = state.get("gaussians", (0, 0))
