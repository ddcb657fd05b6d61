"""Seconds of training as the gate sees them: on the wall, and of the processor."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import NamedTuple

# Seconds on the wall from one reading of the processor's clock to the next, at least. A reading is a system call of 0.3
# to 7 us, so readings take less than 0.1 % of the time. The last ones of a run may be missing: 10 ms at most.
PROCESSOR_INTERVAL = 0.01


class Times(NamedTuple):
    """Seconds of training.

    Attributes:
        t_total: Seconds of all iterations on the wall.
        t_post: Seconds of the iterations from `start_iter` on.
        t_total_processor: Seconds for which threads of this process were running in all iterations, summed over the
            threads. Other programs hardly change them. NaN if a part of the run was not measured.
        t_post_processor: Processor seconds of the iterations from `start_iter` on.
    """

    t_total: float = 0.0
    t_post: float = 0.0
    t_total_processor: float = 0.0
    t_post_processor: float = 0.0


class GateClock:
    """Measures from iteration to iteration; the last iteration is measured up to its backward pass.

    Work between two iterations (evaluation, saving) is included.
    """

    def __init__(self) -> None:
        self._wall = _Stopwatch(time.perf_counter)
        self._processor = _Stopwatch(time.process_time)
        self._read = 0.0  # time on the wall at which the processor's clock was read last
        self._running = False
        self._post = False

    @property
    def times(self) -> Times:
        """Seconds of the iterations so far."""
        wall, processor = self._wall, self._processor
        return Times(wall.total, wall.post, processor.total, processor.post)

    def open(self, post: bool) -> None:
        """Begin an iteration; `post` says whether it comes after `start_iter`."""
        if not self._running:
            self._running = True
            self._wall.start()
            self._processor.start()
            self._read = self._wall.last
        elif post is not self._post:
            self.mark(exactly=True)  # no time before `start_iter` counts as time after it
        self._post = post

    def mark(self, exactly: bool = False) -> None:
        """Book the time since the previous mark to the present iteration.

        Args:
            exactly: Read the processor's clock even if it was read within the last `PROCESSOR_INTERVAL`.
        """
        if not self._running:
            return
        now = self._wall.book(self._post)
        if exactly or now - self._read >= PROCESSOR_INTERVAL:
            self._read = now
            self._processor.book(self._post)

    def state_dict(self) -> dict[str, float]:
        return self.times._asdict()

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Continue from `state_dict()`; the processor seconds of states without them are unknown (NaN)."""
        processor = (state.get(name, math.nan) for name in ("t_total_processor", "t_post_processor"))
        self._wall.total, self._wall.post = state["t_total"], state["t_post"]
        self._processor.total, self._processor.post = processor
        self._running = False


class _Stopwatch:
    """Sums of the seconds of one clock.

    Attributes:
        total: Seconds of all iterations.
        post: Seconds of the iterations from `start_iter` on.
        last: Time of the last booking.
    """

    __slots__ = ("_now", "last", "post", "total")

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self.total = self.post = self.last = 0.0

    def start(self) -> None:
        """Measure from now on."""
        self.last = self._now()

    def book(self, post: bool) -> float:
        """Add the time since the last booking, and return the present time."""
        now = self._now()
        passed = now - self.last
        self.last = now
        self.total += passed
        if post:
            self.post += passed
        return now
