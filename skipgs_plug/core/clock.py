"""Seconds of training, as far as the gate can see them: on the wall, and of the processor."""

from __future__ import annotations

import math
import time
from typing import NamedTuple


class Times(NamedTuple):
    """Seconds of training.

    Attributes:
        t_total: of all iterations, by the clock on the wall.
        t_post: Seconds of iterations from `start_iter` on.
        t_total_processor: as `t_total`, but seconds for which threads of this process were running, added up over
            them. Other programs hardly change them. NaN where a part of the run was not measured.
        t_post_processor: The same for `t_post`.
    """

    t_total: float = 0.0
    t_post: float = 0.0
    t_total_processor: float = 0.0
    t_post_processor: float = 0.0


class GateClock:
    """Seconds from iteration to iteration; the last one counts up to its backward.

    Work between two iterations (evaluation, saving) is included.

    Attributes:
        times: seconds of the iterations seen so far.
    """

    def __init__(self) -> None:
        self.times = Times()
        self._last: tuple[float, float] | None = None
        self._post = False

    def open(self, post: bool) -> None:
        """An iteration begins, after `start_iter` or before."""
        if self._last is None:
            self._last = _now()
        elif post is not self._post:
            self.mark()  # no iteration of one part counts as one of the other
        self._post = post

    def mark(self) -> None:
        """Book the time since the previous mark to the present iteration."""
        if self._last is None:
            return
        now = _now()
        wall, processor = now[0] - self._last[0], now[1] - self._last[1]
        self._last = now
        t_total, t_post, t_total_processor, t_post_processor = self.times
        if self._post:
            t_post, t_post_processor = t_post + wall, t_post_processor + processor
        self.times = Times(t_total + wall, t_post, t_total_processor + processor, t_post_processor)

    def state_dict(self) -> dict[str, float]:
        return self.times._asdict()

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Continue from `state_dict()`; a state of a version without processor seconds leaves them unknown."""
        processor = (state.get(name, math.nan) for name in ("t_total_processor", "t_post_processor"))
        self.times = Times(state["t_total"], state["t_post"], *processor)
        self._last = None


def _now() -> tuple[float, float]:
    """Seconds on the wall and of the processor; asking for the latter is a call of the system (0.3 to 7 us)."""
    return time.perf_counter(), time.process_time()
