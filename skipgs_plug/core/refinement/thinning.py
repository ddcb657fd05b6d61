"""Which iterations run: a share of them, evenly spread, and every one that something hangs on."""

from __future__ import annotations

from typing import Any

GOLDEN = 0.6180339887498949  # its multiples modulo 1 are as even as can be, and periodic with nothing


class Thinning:
    """Spreads a share of the iterations evenly over all of them (error diffusion with a dithered threshold).

    Strictly even gaps would meet loops that take view `step % n` at the same views again and again, so gaps vary.
    An iteration that must run is paid for by those after it, so that the share stays what was asked for as long
    as fewer iterations must run than may.

    Args:
        share: Share of iterations that run, in (0, 1].
    """

    def __init__(self, share: float) -> None:
        self.share = share
        self.run = 0
        self.left_out = 0
        self._credit = 0.5  # as many too many as too few, on average

    def runs(self, number: int, must: bool) -> bool:
        """Whether the next iteration, of this number, runs; `must` says that something hangs on it."""
        self._credit += self.share
        if not must and self.share < 1.0 and self._credit < 0.5 + number * GOLDEN % 1.0:
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
