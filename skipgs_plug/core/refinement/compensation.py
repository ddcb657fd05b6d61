"""Larger, shrinking steps for the paper's gate: they make up for the backwards that it skips."""

from __future__ import annotations

from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.refinement.rates import ScaledRates, path_factor


class Compensation:
    """Scales the learning rates of gated iterations by what the floor leaves of the backwards.

    Args:
        config: With `compensate`.
        start: First gated iteration.
        last: Last iteration of the run.
        rates: What scales.

    Attributes:
        last: iteration after which steps have no length.
    """

    def __init__(self, config: SkipConfig, start: int, last: int, rates: ScaledRates) -> None:
        self._peak = config.rate_peak
        self._start, self.last = start, last
        self._rates = rates

    def heartbeat(self, step: int, floor: float | None) -> None:
        """Iteration `step` begins; `floor` is the least share of real backwards in force, None or 0 without one."""
        if step < self._start:
            self._rates.rest()
            return
        # A trainer may go on after the end that it told: with steps of length 0.
        progress = min((step - self._start) / max(self.last + 1 - self._start, 1), 1.0)
        self._rates.scale(path_factor(floor or 1.0, progress, self._peak, self._rates.shown.share))
