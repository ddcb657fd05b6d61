"""The present iteration: one record that gate, engine, hooks and optimizer steps share."""

from __future__ import annotations

from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision


class GatedIteration:
    """What is known of the present iteration. `begin` is the one place where it is forgotten.

    Attributes:
        step: its number, None before the first.
        gated: whether its backward may be skipped, as far as its number decides.
        opened: number of iterations that have begun with this gate.
        decision: the last answer in it.
        ran: a real backward ran in it.
        view, signal: what a trainer's hooks named for the backward to come.
        backwards: training backwards that hooks saw in it.
        keys: views that `backward` was called on by hand.
        stepped: ids of the optimizers that `step` was called on by hand.
        ended: `update` was called by hand.
    """

    __slots__ = (
        *("backwards", "decision", "ended", "gated", "keys", "opened"),
        *("ran", "signal", "step", "stepped", "view"),
    )

    def __init__(self) -> None:
        self.keys: set[str] = set()
        self.stepped: set[int] = set()
        self.opened = 0
        self.begin(None, gated=False)

    def begin(self, step: int | None, gated: bool) -> None:
        """Forget the previous iteration; `step` is the number of the new one."""
        self.step = step
        self.gated = gated
        self.decision: Decision = decision.INACTIVE
        self.ran = False
        self.view: Any = None
        self.signal: Any = None
        self.backwards = 0
        self.keys.clear()
        self.stepped.clear()
        self.ended = False

    @property
    def skipped(self) -> bool:
        """Whether it has a backward that was skipped, and none that ran."""
        return self.decision.skip and not self.ran
