"""Choose the iterations that run: a share of them, evenly spread, and every iteration that must run."""

from __future__ import annotations

import functools
from typing import Any


class Sampling:
    """Runs one iteration in each slot of 1 / share iterations, at a position in the slot that looks random.

    With strictly even gaps, a loop that trains on view `step % n` would show the same few views again and again. An
    iteration that must run takes the place of a later one. So the share is met as long as fewer iterations must run
    than the share allows.

    Args:
        share: Share of the iterations that run, in [0, 1].

    Attributes:
        run, left_out: Numbers of iterations so far.
    """

    def __init__(self, share: float) -> None:
        self.share = share
        self.run = 0
        self.left_out = 0
        self._due = 0  # number of iterations that should have run by now
        self._since = (0, 0)  # numbers of iterations, and of those due, before the present share

    def set_share(self, share: float) -> None:
        """Run another share from now on, and keep no account of the iterations before."""
        if share != self.share:
            self.share, self._due, self._since = share, self.run, (self.asked, self.run)

    @property
    def asked(self) -> int:
        """Number of iterations so far."""
        return self.run + self.left_out

    @property
    def due(self) -> int:
        """Number of iterations that the share has asked for by now; further ones ran because they must."""
        return self._due if 0.0 < self.share < 1.0 else self.run + (self.share > 0.0)

    def runs(self, must: bool, barred: bool = False) -> bool:
        """Decide whether the next iteration runs, and count it.

        Args:
            must: The iteration runs in any case.
            barred: The iteration is left out, and a later one takes its place.
        """
        if barred:
            self.left_out += 1
            return False
        if 0.0 < self.share < 1.0:
            asked, due = self._since
            number = self.asked - asked + 1  # of this iteration, counted from the change of the share
            while (self._due - due + _position(self._due)) / self.share < number:
                self._due += 1
            must = must or self.run < self._due
        else:
            must = must or self.share > 0.0
        if must:
            self.run += 1
        else:
            self.left_out += 1
        return must

    def state_dict(self) -> dict[str, Any]:
        return {"share": self.share, "run": self.run, "left_out": self.left_out, "due": self._due, "since": self._since}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.share = float(state["share"])
        self.run, self.left_out, self._due = int(state["run"]), int(state["left_out"]), int(state["due"])
        asked, due = state.get("since", (0, 0))  # earlier states do not have it
        self._since = (int(asked), int(due))


@functools.lru_cache(maxsize=1)  # every iteration of a slot asks
def _position(slot: int) -> float:
    """Return the position in a slot, in [0, 1), by SplitMix64's finaliser: repeatable, and without a period."""
    mixed = (slot * 0x9E3779B97F4A7C15 + 0x9E3779B97F4A7C15) % (1 << 64)
    mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) % (1 << 64)
    mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) % (1 << 64)
    return (mixed ^ (mixed >> 31)) / (1 << 64)
