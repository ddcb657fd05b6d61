"""Checkpoints during training, so that a killed process loses only minutes."""

from __future__ import annotations

from skipgs_plug.files import keep_going
from skipgs_plug.trainer.loop import Iteration, Trainer
from skipgs_plug.trainer.run_folder import RunFolder

SECONDS = 300.0  # training time between two checkpoints by default: a killed run loses at most five minutes


class Autosave:
    """Writes checkpoints at intervals. A checkpoint that cannot be written is reported, and training continues.

    Args:
        every: Iterations between two checkpoints; None for five minutes of training, 0 for no checkpoints.
    """

    def __init__(self, folder: RunFolder, trainer: Trainer, every: int | None) -> None:
        self._folder, self._trainer, self._every = folder, trainer, every
        self._saved_at, self._saved_step = trainer.t_total, trainer.step

    def save(self) -> None:
        """Write a checkpoint, unless this session began or saved in this iteration.

        Raises:
            WriteError: The checkpoint cannot be written.
        """
        if self._trainer.step != self._saved_step:
            self._folder.write_checkpoint(self._trainer)
            self._saved_step = self._trainer.step

    def iteration(self, iteration: Iteration) -> None:
        """Save when it is time; may serve as `Trainer.on_step`."""
        if not self._due(iteration):
            return
        with keep_going([]):
            self.save()
        self._saved_at = self._trainer.t_total

    def _due(self, iteration: Iteration) -> bool:
        if iteration.step + 1 == self._trainer.max_steps:  # the session itself saves the end
            return False
        if self._every is None:
            return self._trainer.t_total - self._saved_at >= SECONDS
        return self._every > 0 and iteration.completes(self._every)
