"""Share of the Gaussians that a view shows, measured by the gradients that the trainer computes."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from skipgs_plug.core import distributed

# Names of the positions. Regularisers fill the gradients of opacities and scales in some trainers, but not theirs.
POSITIONS = ("xyz", "means", "means3d", "means3D", "position", "positions")
# Share of the Gaussians that a view shows while it is not measured. A third is typical of a room photographed from
# within.
VISIBLE = 1 / 3
STEPS = 100  # number of optimizer steps in the mean, so that it does not depend on the first few views
# Numbers of measured steps after which sums on a device are read, or reduced over processes. Each read waits for all
# work of the device, so there are ten, close together at first because the first steps decide on shares.
READ_AT = frozenset((1, 2, 4, 8, 14, 20, 30, 45, 65, STEPS))
ROWS = 8192  # rows of a gradient that are measured, evenly spread; the standard error of a share is below 0.006


class Visibility:
    """Mean, over the first steps, of the share of the Gaussians whose positions have a gradient.

    On the CPU each step counts at once. On a device, sums stay there and are read ten times in all. Several processes
    then agree on their mean, since each of them trains on other views.

    Attributes:
        complete: Whether enough steps were measured.
    """

    def __init__(self) -> None:
        self.restart()

    @property
    def visible(self) -> float | None:
        """The mean, in (0, 1]; None before the first step, and for a model without a group of positions."""
        return self._sum / self._steps if self._steps else None

    @property
    def steps(self) -> int:
        """Number of steps in the mean, at most `STEPS`."""
        return round(self._steps)

    def restart(self) -> None:
        """Measure afresh, because the scene has grown."""
        self._sum = self._steps = 0.0
        self._looks = 0
        self.complete = False
        self._unread: Tensor | None = None  # sum of shares and number of steps that were not read yet  # [2]

    def finish(self) -> None:
        """Measure no further steps until `restart`; on a device a measurement can wait for all work."""
        self.complete = True

    def see(self, positions: Iterable[Tensor]) -> None:
        """Measure a step that is about to run.

        Args:
            positions: Parameters of the optimizer that may be positions [N, 3]; the first with a gradient counts.
        """
        if self.complete:
            return
        gradient = next((param.grad for param in positions if param.grad is not None), None)
        if gradient is None:
            return
        visible = visible_share(gradient)
        if distributed.group_size() == 1 and visible.device.type == "cpu":
            shown = visible.item()
            if shown > 0.0:  # a step without gradients belongs to no view
                self._sum, self._steps, self._looks = self._sum + shown, self._steps + 1, self._looks + 1
                self.complete = self._looks >= STEPS
            return
        self._looks += 1
        self.complete = self._looks >= STEPS
        now = torch.stack([visible, (visible > 0.0).to(visible.dtype)])
        self._unread = now if self._unread is None else self._unread.to(now) + now
        if self._looks in READ_AT:
            total, steps = distributed.mean(self._unread)
            self._sum, self._steps, self._unread = self._sum + total, self._steps + steps, None

    def state_dict(self) -> list[float]:
        """Return the sum of shares, the steps in it, the measured steps, and the sum and steps that were not read."""
        unread = [0.0, 0.0] if self._unread is None else self._unread.cpu().tolist()
        return [self._sum, self._steps, self._looks, *unread]

    def load_state_dict(self, state: list[float]) -> None:
        self._sum, self._steps = float(state[0]), float(state[1])
        self._looks = int(state[2])
        self.complete = self._looks >= STEPS
        self._unread = None if state[4] == 0.0 else torch.tensor(state[3:], dtype=torch.float64)


def visible_share(gradient: Tensor) -> Tensor:
    """Return the share of the rows of a gradient [N, K], dense or sparse, that are not all 0, on its device."""
    count = max(len(gradient), 1)
    exact = torch.float64 if gradient.device.type == "cpu" else torch.float32  # some devices have no float64
    if gradient.is_sparse:
        values = gradient._values()
        listed = values.reshape(len(values), -1).any(1)
        reached = torch.zeros(count, dtype=torch.int32, device=gradient.device)
        reached.index_add_(0, gradient._indices()[0], listed.to(torch.int32))
        return (reached > 0).sum().to(exact) / count
    rows = gradient[:: max(len(gradient) // ROWS, 1)]
    return rows.any(1).sum().to(exact) / max(len(rows), 1)
