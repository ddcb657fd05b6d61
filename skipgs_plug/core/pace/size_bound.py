"""Bound on longer steps of scales: they do not make a Gaussian larger than the scene."""

from __future__ import annotations

import math

import torch
from torch import Tensor

# The bound, as a multiple of the median distance of the Gaussians from their median. Room must be left for the
# background: with a quarter of it, Inria's script ends 0.3 dB (.008 SSIM) lower on bonsai.
SPREAD = 2.5
ROWS = 8192  # positions that are measured, evenly spread


class SizeBound:
    """Gives sizes beyond a bound the trainer's own steps where they would grow.

    Scales are logarithms, so a step multiplies a size. A Gaussian beyond the scene that some views show at their edge
    grows as long as that fills their background. The trainer's steps stop it in time, longer ones do not: on fox one
    Gaussian grew to 20 times the size of the cameras' circle, and covered a held-out view (21.7 instead of 28.4 dB).

    Nothing is read from a device.
    """

    def __init__(self) -> None:
        self._bound: Tensor | None = None  # []

    @property
    def measured(self) -> bool:
        """Whether there is a bound."""
        return self._bound is not None

    def measure(self, positions: Tensor) -> None:
        """Set the bound, once, by the positions [N, 3] of the Gaussians."""
        if self.measured or not len(positions):
            return
        some = positions.detach()[:: max(len(positions) // ROWS, 1)]
        spread = SPREAD * (some - some.median(0).values).norm(dim=1).median()
        self._bound = torch.where(spread > 0.0, spread.log(), math.inf)

    def shorten(self, scales: Tensor, before: Tensor, times: float) -> None:
        """Shorten growth beyond the bound to that of a step that is not longer.

        Args:
            scales: Logarithms of sizes [N, K] after the step; changed in place.
            before: The same before the step; changed in place.
            times: How many times as long as the trainer's own the step was.
        """
        if self._bound is None:
            return
        scales = scales.detach()
        most = torch.fmax(before.lerp_(scales, 1.0 / times), self._bound.to(before))
        torch.minimum(scales, most, out=scales)

    def state_dict(self) -> float | None:
        """Return the bound, as the logarithm of a size; None before it is measured."""
        return None if self._bound is None else self._bound.item()

    def load_state_dict(self, state: float | None) -> None:
        self._bound = None if state is None else torch.tensor(state, dtype=torch.float64)
