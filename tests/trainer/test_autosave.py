"""When checkpoints are written on the way."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch

from skipgs_plug.trainer.autosave import Autosave
from skipgs_plug.trainer.loop import Iteration

NOTHING = torch.empty(0)


@pytest.mark.parametrize(
    ("every", "expected"),
    # Of 30 iterations every third runs, for 300 seconds.
    [(None, [3, 6, 9, 12, 15, 18, 21, 24, 27]), (10, [12, 21]), (0, [])],
)
def test_checkpoints_come_by_time_or_by_iterations(every: int | None, expected: list[int]) -> None:
    trainer: Any = SimpleNamespace(step=0, t_total=0.0, max_steps=30)
    saved: list[int] = []
    folder: Any = SimpleNamespace(write_checkpoint=lambda trainer: saved.append(trainer.step))
    autosave = Autosave(folder, trainer, every)
    for step in range(2, 30, 3):
        since, trainer.step = trainer.step, step + 1
        trainer.t_total += 300.0
        autosave.iteration(Iteration(step, since, "view", 0.5, NOTHING, NOTHING))
    assert saved == expected
    autosave.save()
    autosave.save()
    assert saved == [*expected, 30]


def test_time_counts_from_the_last_checkpoint() -> None:
    trainer: Any = SimpleNamespace(step=0, t_total=0.0, max_steps=100)
    saved: list[int] = []
    folder: Any = SimpleNamespace(write_checkpoint=lambda trainer: saved.append(trainer.step))
    autosave = Autosave(folder, trainer, None)
    for step in range(10):
        trainer.step, trainer.t_total = step + 1, trainer.t_total + 100.0
        autosave.iteration(Iteration(step, step, "view", 0.5, NOTHING, NOTHING))
    assert saved == [3, 6, 9]
