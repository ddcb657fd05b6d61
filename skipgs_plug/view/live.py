"""The page while a model trains."""

from __future__ import annotations

import time

from skipgs_plug.trainer.loop import Iteration, Trainer
from skipgs_plug.view.page import Page

SHARE = 0.02  # share of the training time that page updates may take
EVERY = 2.0  # seconds between two updates of the page, at least
LOOK = 0.5  # seconds between two checks whether somebody has the page open


class LiveView:
    """Shows a trainer's model as it grows; its `iteration` may serve as `Trainer.on_step`.

    It does not touch parameters or random state, so training gives the same result. Each update is timed. The next one
    waits until updates take less than 2 % of the training time. Without visitors, there is no update.
    """

    def __init__(self, trainer: Trainer, port: int = 8080) -> None:
        self._trainer = trainer
        self.page = Page(trainer.scene, lambda _, view: trainer.render(view).clamp(0, 1), port=port)
        self._next = 0.0

    def iteration(self, iteration: Iteration) -> None:
        """Show the model, if an update is due and somebody has the page open."""
        now = time.perf_counter()
        if now < self._next:
            return
        if self.page.visitors == 0:
            self._next = now + LOOK
            return
        self.page.show(
            dict(self._trainer.splats.items()), f"Iteration {iteration.step:,} of {self._trainer.max_steps:,}"
        )
        done = time.perf_counter()
        self._next = done + max(EVERY, (done - now) / SHARE)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *error: object) -> None:
        self.page.stop()
