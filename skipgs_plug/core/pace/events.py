"""Densification events: which of them a thinned growing phase keeps."""

from __future__ import annotations

import bisect
from collections.abc import Iterable
from typing import Any

from skipgs_plug.core.pace.needs import NEARLY_ALL
from skipgs_plug.core.trainer_info import Densification

# Visits of each Gaussian behind an event. Densification grows what has a large mean gradient over its visits: over
# fewer, the means are noisier, and more of them lie above the threshold (bonsai with 10 visits: 17 to 90 % more
# Gaussians). Over more, events are fewer, and a scene that must grow far does not get there (Lego). What a view shows
# is measured after each event. 20 visits keep bonsai at 86 to 103 % of its Gaussians.
VISITS_BEHIND = 20.0
# Where a view shows nearly all, growth is limited by the number of events instead: every second one ends with half of
# Lego's Gaussians.
VISITS_BEHIND_FULL_VIEWS = 8.0
VISIBLE = 1 / 3  # share of the Gaussians that a view shows, before it is measured


class Events:
    """Decides event by event whether enough stands behind it.

    An event that is not kept leaves its statistics to the next one.

    Args:
        numbers: Iterations with an event.
        densification: What this trainer's events need.

    Attributes:
        kept, left_out: events counted so far.
    """

    def __init__(self, numbers: Iterable[int], densification: Densification) -> None:
        self._numbers = sorted(numbers)
        self._known = frozenset(self._numbers)
        self._needs = densification.needs
        self.kept = self.left_out = 0
        self._behind = 0  # iterations that ran since the last event

    def __contains__(self, number: int) -> bool:
        return number in self._known

    def __len__(self) -> int:
        return len(self._numbers)

    @property
    def end(self) -> int | None:
        """Iteration at which one more event would follow the last one upstream; None without events."""
        return self._numbers[-1] + self._distance(self._numbers[-1]) if self._numbers else None

    @property
    def all_run(self) -> bool:
        """Whether each event runs, however few iterations stand behind it."""
        return self._needs == "nothing"

    def ran(self, number: int) -> None:
        """An iteration runs, with its event if it has one."""
        if number in self._known:
            self.kept += 1
            self._behind = 0
        else:
            self._behind += 1

    def skipped(self, number: int) -> None:
        """An iteration is left out, with its event if it has one."""
        self.left_out += number in self._known

    def enough(self, number: int, visible: float | None) -> bool:
        """Whether enough stands behind the event in iteration `number`.

        Args:
            number: Iteration with an event.
            visible: Share of the Gaussians that a view shows; None if unknown.
        """
        if self.all_run:
            return True
        distance = self._distance(number)
        # The event's own iteration adds to its statistics too.
        behind = self._behind + 1
        if self._needs == "iterations":
            return behind >= distance
        visible = visible or VISIBLE
        visits = VISITS_BEHIND_FULL_VIEWS if visible >= NEARLY_ALL else VISITS_BEHIND
        return behind * visible >= min(visits, distance * visible)

    def _distance(self, number: int) -> int:
        """Iterations from the event before to this one in the trainer's own schedule."""
        place = bisect.bisect_left(self._numbers, number)
        before = self._numbers[place - 1] if place else 0
        return number - before

    def state_dict(self) -> dict[str, Any]:
        return {"kept": self.kept, "left_out": self.left_out, "behind": self._behind}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.kept, self.left_out, self._behind = int(state["kept"]), int(state["left_out"]), int(state["behind"])
