"""The present iteration: one record that the gate, the engine and the hooks share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skipgs_plug.core import decision
from skipgs_plug.core.decision import Decision


class GatedIteration:
    """Facts about the present iteration, which `begin` resets. `opened`, `passes` and `running` outlast it.

    Attributes:
        step: Number of the iteration; None before the first.
        gated: Whether the iteration is at or after `start_iter` and the gate is on.
        opened: Number of iterations that have begun with this gate.
        decision: The last decision in the iteration.
        ran: Whether a real backward pass ran in the iteration.
        running: Whether a real backward pass has begun and has not returned, so that an error comes from the trainer.
            `OwnLoop.backward` resets it at the start of each call.
        passes: Number of real backward passes that have returned with this gate.
        view, signal: View and value that the trainer's hooks reported for the coming backward pass.
        backwards: Number of training backward passes that the hooks saw.
        keys: Keys of the views that the user called `backward` with.
        stepped: Ids of the optimizers that the user called `step` with.
        ended: Whether the user called `update`.
    """

    __slots__ = (
        *("backwards", "decision", "ended", "gated", "keys", "opened", "passes"),
        *("ran", "running", "signal", "step", "stepped", "view", "__weakref__"),
    )

    def __init__(self) -> None:
        self.keys: set[str] = set()
        self.stepped: set[int] = set()
        self.opened = self.passes = 0
        self.running = False
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

    def run(self, backward: Callable[[], Any]) -> None:
        """Call `backward`, a real backward pass."""
        self.running = True
        backward()
        self.running = False
        self.passes += 1
        self.ran = True

    @property
    def skipped(self) -> bool:
        """Whether a backward pass was skipped in the iteration and no other one ran."""
        return self.decision.skip and not self.ran
