"""Facts about one iteration of the reference trainer."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Iteration(NamedTuple):
    """Facts about one iteration, for `Trainer.on_step`."""

    step: int
    since: int  # number right after the previous iteration; below `step` if a gate left out iterations between
    view: str
    loss: float
    image: Tensor  # [H, W, 3], detached
    target: Tensor  # [H, W, 3] uint8

    def passes(self, every: int) -> bool:
        """Whether this iteration, or a left-out iteration right before it, is a multiple of `every`."""
        return self.step // every > (self.since - 1) // every

    def completes(self, every: int) -> bool:
        """Whether this iteration completes a multiple of `every` iterations, left-out ones included."""
        return (self.step + 1) // every > self.since // every
