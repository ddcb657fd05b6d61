"""The loss of a run over iterations and seconds, averaged for plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from skipgs_plug.trainer.files import write_json
from skipgs_plug.trainer.loop import Iteration, Trainer

POINTS = 500  # points of the loss curve of a whole run: more only make the report larger


class LossCurve:
    """Means of the loss over equal parts of a run. Its `iteration` may serve as `Trainer.on_step`.

    The trainer's checkpoints hold it, so that a resumed run has one curve.
    """

    def __init__(self, trainer: Trainer) -> None:
        self._trainer = trainer
        self._every = max(1, trainer.max_steps // POINTS)
        self._pending: list[float] = []
        self._columns: dict[str, list[Any]] = {"step": [], "seconds": [], "loss": [], "num_GS": []}
        trainer.register_state("loss_curve", self)

    def iteration(self, iteration: Iteration) -> None:
        """Add one iteration."""
        self._pending.append(iteration.loss)
        if len(self._pending) < self._every:
            return
        values = (
            iteration.step,
            round(self._trainer.t_total, 3),
            sum(self._pending) / len(self._pending),
            self._trainer.num_gaussians,
        )
        for column, value in zip(self._columns.values(), values, strict=True):
            column.append(value)
        self._pending.clear()

    def write(self, path: str | Path) -> None:
        """Write the columns `step` (last of its part), `seconds` of training so far, mean `loss`, `num_GS`."""
        write_json(path, self._columns)

    def state_dict(self) -> dict[str, Any]:
        return {"pending": list(self._pending), **{name: list(column) for name, column in self._columns.items()}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._pending = list(state["pending"])
        self._columns = {name: list(state[name]) for name in self._columns}
