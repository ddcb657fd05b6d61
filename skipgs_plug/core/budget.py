"""The floor: the least share of the recorded iterations that must run a real backward pass."""

from __future__ import annotations

from typing import Any

# Number of recorded iterations from which the floor applies; a share of fewer says little. The authors' value.
MIN_SAMPLES = 100
UNCALIBRATED_FLOOR = 0.5  # floor until warm-up has set it; the authors' value


class BackwardBudget:
    """Counts recorded backward passes and skips, and decides whether the floor allows another skip.

    Attributes:
        floor: Floor in force; 0.5 until an "auto" floor is calibrated.
        backwards: Number of recorded iterations with a backward pass, warm-up included.
        skips: Number of recorded iterations without a backward pass.
        calibrating: Whether an "auto" floor still waits for the first recorded iteration after warm-up.
        would_skip, would_total: Number of warm-up visits that the rule would have skipped, and of all that it judged.
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
        """Whether another skip keeps the share of backward passes at or above the floor."""
        total = self.backwards + self.skips
        return total <= MIN_SAMPLES or self.backwards / total >= self.floor

    def observe_warmup(self, would_skip: bool) -> None:
        """Record whether the rule would have skipped a warm-up visit of a view that has a mean."""
        self.would_total += 1
        if would_skip:
            self.would_skip += 1

    def calibrate(self) -> None:
        """Set an "auto" floor from the visits of warm-up; it stays at 0.5 if there was none."""
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
