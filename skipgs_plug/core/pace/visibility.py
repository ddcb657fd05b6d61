"""Share of the Gaussians that a view shows, read off the gradients of a trainer that does not tell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.core import distributed

POSITIONS = ("xyz", "means")  # no regulariser fills their gradient, as some do that of opacities and scales
STEPS = 100  # that are looked at
# Looks after which what lies on a device is read, or agreed on with other processes: each read waits for all work.
READ_AT = frozenset((1, 2, 4, 8, 14, 20, 30, 45, 65, STEPS))
ROWS = 8192  # of a gradient that are looked at


class Visibility:
    """Mean over the first steps of the share of Gaussians whose positions have a gradient.

    On the CPU each step counts at once. On a device, sums stay there and are read ten times in all; several processes
    agree on their mean then, since each sees views of its own.

    Attributes:
        complete: whether enough steps were looked at.
    """

    def __init__(self) -> None:
        self.restart()

    @property
    def share(self) -> float | None:
        """In (0, 1]; None before the first step, and of a model without such a group."""
        return self._sum / self._steps if self._steps else None

    @property
    def steps(self) -> int:
        """Steps seen so far, at most `STEPS`; on a device, those that were read."""
        return round(self._steps)

    def restart(self) -> None:
        """Forget everything: the scene has grown since."""
        self._sum = self._steps = 0.0
        self._looks = 0
        self.complete = False
        self._unread: Tensor | None = None  # sum of shares and number of steps that are not in the above  # [2]

    def finish(self) -> None:
        """Look at no further steps until `restart`: on a device each look can be a read that waits for all work."""
        self.complete = True

    def see(self, groups: list[dict[str, Any]], name: str | None) -> None:
        """An optimizer is about to step; `name` is that of groups without a `name`, if it is known.

        Without names the first parameter [N, 3] is taken for the positions.
        """
        if self.complete:
            return
        param = next((param for param in positions(groups, name) if param.grad is not None), None)
        if param is None or param.grad is None:
            return
        share = reached_share(param.grad)
        if distributed.group_size() == 1 and share.device.type == "cpu":
            reached = share.item()
            if reached > 0.0:  # else the step has no view
                self._sum, self._steps, self._looks = self._sum + reached, self._steps + 1, self._looks + 1
                self.complete = self._looks >= STEPS
            return
        self._looks += 1
        self.complete = self._looks >= STEPS
        now = torch.stack([share, (share > 0.0).to(share.dtype)])
        self._unread = now if self._unread is None else self._unread.to(now) + now
        if self._looks in READ_AT:
            total, steps = distributed.mean(self._unread)
            self._sum, self._steps, self._unread = self._sum + total, self._steps + steps, None

    def state_dict(self) -> list[float]:
        """Sum of shares, steps, looks, and of what is not read yet the sum and steps."""
        unread = [0.0, 0.0] if self._unread is None else self._unread.cpu().tolist()
        return [self._sum, self._steps, self._looks, *unread]

    def load_state_dict(self, state: list[float]) -> None:
        self._sum, self._steps = float(state[0]), float(state[1])
        self._looks = int(state[2])
        self.complete = self._looks >= STEPS
        self._unread = None if state[4] == 0.0 else torch.tensor(state[3:], dtype=torch.float64)


def positions(groups: list[dict[str, Any]], name: str | None) -> Iterator[Tensor]:
    """Yield the parameters that may be positions [N, 3]; arguments as for `Visibility.see`."""
    for group in groups:
        known = group.get("name", name)
        for param in group["params"] if known is None or known in POSITIONS else ():
            if param.ndim == 2 and param.shape[1] == 3:
                yield param


def reached_share(gradient: Tensor) -> Tensor:
    """Return the share of rows of a gradient [N, K], dense or sparse, that are not all 0; where it lies, unread."""
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
