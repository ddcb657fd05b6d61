"""Which iterations run: a share of them, evenly spread, and every one that something hangs on."""

from __future__ import annotations

from typing import Any


class Thinning:
    """Spreads a share of the iterations evenly over all of them (error diffusion, as in Bresenham's lines).

    An iteration that must run is paid for by those after it, so that the share stays what was asked for as long
    as fewer iterations must run than may.

    Args:
        share: Share of iterations that run, in (0, 1].
    """

    def __init__(self, share: float) -> None:
        self.share = share
        self.run = 0
        self.left_out = 0
        self._credit = 0.5  # the first gap is half as long as the others, as is the last

    def runs(self, must: bool) -> bool:
        """Whether the next iteration runs; `must` says that something hangs on it."""
        self._credit += self.share
        # Rounding must not leave out an iteration of a loop that runs them all.
        if not must and self._credit < 1.0 - 1e-9:
            self.left_out += 1
            return False
        self._credit -= 1.0
        self.run += 1
        return True

    def state_dict(self) -> dict[str, Any]:
        return {"share": self.share, "run": self.run, "left_out": self.left_out, "credit": self._credit}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.share, self._credit = float(state["share"]), float(state["credit"])
        self.run, self.left_out = int(state["run"]), int(state["left_out"])
