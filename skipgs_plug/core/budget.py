"""The floor: the least share of recorded iterations that run a real backward."""

from __future__ import annotations

from typing import Any

MIN_SAMPLES = 100  # iterations recorded before the floor is in force; of fewer, the share says little (authors' value)
UNCALIBRATED_FLOOR = 0.5  # floor until warm-up has set one (authors' value)


class BackwardBudget:
    """Counts recorded backwards and skips, and says whether one more skip is affordable.

    Attributes:
        floor: share in force; 0.5 until an "auto" floor is calibrated.
        backwards: recorded iterations with a backward, warm-up included.
        skips: recorded iterations without.
        calibrating: an "auto" floor waits for the first recorded iteration after warm-up.
    """

    __slots__ = ("backwards", "calibrating", "floor", "skips", "would_skip", "would_total")

    def __init__(self, min_bwd_ratio: float | str) -> None:
        self.calibrating = min_bwd_ratio == "auto"
        self.floor = UNCALIBRATED_FLOOR if self.calibrating else float(min_bwd_ratio)
        self.backwards = 0
        self.skips = 0
        self.would_skip = 0
        self.would_total = 0

    def allows_skip(self) -> bool:
        """False while too few backwards were run."""
        total = self.backwards + self.skips
        return total <= MIN_SAMPLES or self.backwards / total >= self.floor

    def observe_warmup(self, would_skip: bool) -> None:
        """Record the rule's decision on a warm-up visit of a view that has a mean."""
        self.would_total += 1
        if would_skip:
            self.would_skip += 1

    def calibrate(self) -> None:
        """Set an "auto" floor from the decisions of warm-up; without any, it stays 0.5."""
        if self.would_total > 0:
            self.floor = max(0.5, 1.0 - 0.5 * (self.would_skip / self.would_total))
            self.calibrating = False

    def state_dict(self) -> dict[str, Any]:
        return {
            "floor": self.floor,
            "backwards": self.backwards,
            "skips": self.skips,
            "calibrating": self.calibrating,
            "would_skip": self.would_skip,
            "would_total": self.would_total,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.floor = float(state["floor"])
        self.backwards = int(state["backwards"])
        self.skips = int(state["skips"])
        self.calibrating = bool(state["calibrating"])
        self.would_skip = int(state["would_skip"])
        self.would_total = int(state["would_total"])
