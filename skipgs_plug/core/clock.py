"""Wall clock of training, as far as the gate can see it."""

from __future__ import annotations

import time


class GateClock:
    """Seconds from iteration to iteration; the last one counts up to its backward.

    What a trainer does between two iterations (evaluation, saving) is in these figures.

    Attributes:
        t_total: seconds of all iterations seen.
        t_post: seconds of those from `start_iter` on.
    """

    def __init__(self) -> None:
        self.t_total = 0.0
        self.t_post = 0.0
        self._last: float | None = None
        self._post = False

    def open(self, post: bool) -> None:
        """An iteration begins, after `start_iter` or before."""
        self.mark()
        self._last = time.perf_counter()
        self._post = post

    def mark(self) -> None:
        """Book the time since the previous mark to the present iteration."""
        if self._last is None:
            return
        now = time.perf_counter()
        self.t_total += now - self._last
        if self._post:
            self.t_post += now - self._last
        self._last = now

    def state_dict(self) -> dict[str, float]:
        return {"t_total": self.t_total, "t_post": self.t_post}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self.t_total, self.t_post = float(state["t_total"]), float(state["t_post"])
        self._last = None
