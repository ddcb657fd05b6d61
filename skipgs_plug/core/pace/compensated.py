"""The pace of the paper's gate with larger, shrinking steps, which make up for skipped backward passes."""

from __future__ import annotations

from collections.abc import Iterable

from skipgs_plug.core import distributed
from skipgs_plug.core.config import SkipConfig
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.pace.base import EveryNumber, Pace, Source
from skipgs_plug.core.pace.loop_range import LoopRange, require_planned
from skipgs_plug.core.pace.rates import ScaledRates, path_factor
from skipgs_plug.core.policy import Policy
from skipgs_plug.core.trainer_info import Densification, TrainerInfo


class Compensated(Pace):
    """Runs every iteration, and scales the learning rates of gated iterations by the policy's floor.

    Args:
        config: Settings with `compensate`.
        rates: Scales learning rates.
    """

    def __init__(self, config: SkipConfig, rates: ScaledRates) -> None:
        self._config = config
        self._rates = rates
        self._start = 0
        self._last: int | None = None  # last iteration, after which steps have length 0

    def configure(self, start: int, info: TrainerInfo, views: list[str] | None) -> None:
        self._start = start
        if info.max_steps is not None:
            self._plan(range(info.max_steps + 1))

    def follow(
        self,
        numbers: range,
        source: Source | None,
        always: Iterable[int] | None = None,
        views: list[str] | None = None,
        densification: Densification | None = None,
    ) -> LoopRange:
        self._plan(numbers)
        return LoopRange(numbers, EveryNumber(self._rates.pause))

    def begin(self, step: int, policy: Policy | None) -> None:
        if self._last is None:
            needed = "compensate=True must know the last iteration"
            raise SkipGSError(
                f"{needed}: write the loop as for step in gate.iterations(range(...)).",
                in_script=f"{needed}, which this trainer does not tell; use the gate without it.",
            )
        if step < self._start:
            self._rates.pause()
            return
        # A trainer may go on after the last iteration that it announced. Its steps then have length 0.
        progress = min((step - self._start) / max(self._last + 1 - self._start, 1), 1.0)
        floor = (policy.floor if policy is not None else None) or 1.0
        self._rates.scale(path_factor(floor, progress, self._config.rate_peak, self._rates.visibility.visible))

    def _plan(self, numbers: range) -> None:
        if not numbers:
            return
        if self._last is not None:
            require_planned(numbers, self._last)
            return
        if self._config.min_bwd_ratio == "auto":
            distributed.refuse_several(
                "compensate=True scales learning rates by a floor that each process finds by itself",
                "give min_bwd_ratio, such as 0.5",
            )
        self._last = numbers[-1]
