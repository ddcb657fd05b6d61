"""A policy that skips every gated backward."""

from __future__ import annotations

from skipgs_plug.core.decision import Decision
from skipgs_plug.core.policy import Policy


class Always(Policy):
    """Remembers at which iterations it was asked."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def decide(self, view, loss, step) -> Decision:
        self.asked.append(step)
        return Decision(True, "always")

    def notify_event(self, step, n_views) -> None: ...

    def state_dict(self) -> dict:
        return {}

    def load_state_dict(self, state) -> None: ...
