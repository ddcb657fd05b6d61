"""Whether the points that a scene begins with fade in its first steps, as random points in empty space do."""

from __future__ import annotations

import torch
from torch import Tensor

from skipgs_plug.core import distributed

# Share of the opacities that must fall. After 20 steps, 61 to 83 % of random points have fallen (Lego, 1,000 to 100,000
# of them), and 27 to 47 % of points that were reconstructed from photographs (fern, bonsai) or lie on surfaces.
MOST = 0.55


class Fading:
    """Compares the opacities of the first steps with those before them.

    Nothing is read from a device until `finish`.
    """

    def __init__(self) -> None:
        self._before: Tensor | None = None
        self._now: Tensor | None = None
        self._over = False

    def see(self, opacities: Tensor) -> None:
        """Take note of a step that is about to run.

        Args:
            opacities: The optimizer's parameter, in any scale that rises with the opacity.
        """
        if self._over:
            return
        if self._before is None:
            self._before = opacities.detach().clone()
        self._now = opacities

    def stop(self) -> None:
        """Take no note of further steps, and keep nothing."""
        self._before = self._now = None
        self._over = True

    def finish(self) -> bool:
        """Stop, and return whether most opacities that changed fell; False if none was seen.

        All processes must call it together.
        """
        before, now = self._before, self._now
        self.stop()
        counts = torch.zeros(2)
        if before is not None and now is not None and before.shape == now.shape:
            change = now.detach() - before
            counts = torch.stack([(change < 0.0).sum(), (change != 0.0).sum()]).float()
        fell, moved = distributed.mean(counts)
        return moved > 0.0 and fell > MOST * moved
