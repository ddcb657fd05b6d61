"""The present iteration: one record that the gate, the engine and the hooks share."""

from __future__ import annotations

from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision


class GatedIteration:
    """Facts about the present iteration. Only `begin` resets them.

    Attributes:
        step: Number of the iteration; None before the first.
        gated: Whether the iteration is at or after `start_iter` and the gate is on.
        opened: Number of iterations that have begun with this gate.
        decision: The last decision in the iteration.
        ran: Whether a real backward pass ran in the iteration.
        view, signal: View and value that the trainer's hooks reported for the coming backward pass.
        backwards: Number of training backward passes that the hooks saw.
        keys: Keys of the views that the user called `backward` with.
        stepped: Ids of the optimizers that the user called `step` with.
        ended: Whether the user called `update`.
    """

    __slots__ = (
        *("backwards", "decision", "ended", "gated", "keys", "opened"),
        *("ran", "signal", "step", "stepped", "view", "__weakref__"),
    )

    def __init__(self) -> None:
        self.keys: set[str] = set()
        self.stepped: set[int] = set()
        self.opened = 0
        self.begin(None, gated=False)

    def begin(self, step: int | None, gated: bool) -> None:
        """Reset all facts for iteration `step`."""
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
        """Whether a backward pass was skipped in the iteration and no other one ran."""
        return self.decision.skip and not self.ran
