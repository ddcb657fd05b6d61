"""Share of the Gaussians that a view shows, read off the gradients of a trainer that does not tell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from torch import Tensor

POSITIONS = ("xyz", "means")  # no regulariser fills their gradient, as some do that of opacities and scales
STEPS = 100  # that are looked at
ROWS = 8192  # of a gradient that are looked at


class Visibility:
    """Mean over the first steps of the share of Gaussians whose positions have a gradient."""

    def __init__(self) -> None:
        self._sum = 0.0
        self._steps = 0

    @property
    def share(self) -> float | None:
        """In (0, 1]; None before the first step, and of a model without such a group."""
        return self._sum / self._steps if self._steps else None

    @property
    def steps(self) -> int:
        """Steps seen so far, at most `STEPS`."""
        return self._steps

    def restart(self) -> None:
        """Forget everything: the scene has grown since."""
        self._sum, self._steps = 0.0, 0

    def see(self, groups: list[dict[str, Any]], name: str | None) -> None:
        """An optimizer is about to step; `name` is that of groups without a `name`, if it is known.

        Without names the first parameter [N, 3] is taken for the positions.
        """
        if self._steps == STEPS:
            return
        param = next((param for param in positions(groups, name) if param.grad is not None), None)
        if param is None or param.grad is None:
            return
        reached = reached_share(param.grad)
        if reached > 0.0:  # else the step has no view
            self._sum += reached
            self._steps += 1

    def state_dict(self) -> list[float]:
        return [self._sum, self._steps]

    def load_state_dict(self, state: list[float]) -> None:
        self._sum, self._steps = float(state[0]), int(state[1])


def positions(groups: list[dict[str, Any]], name: str | None) -> Iterator[Tensor]:
    """Yield the parameters that may be positions [N, 3]; arguments as for `Visibility.see`."""
    for group in groups:
        known = group.get("name", name)
        for param in group["params"] if known is None or known in POSITIONS else ():
            if param.ndim == 2 and param.shape[1] == 3:
                yield param


def reached_share(gradient: Tensor) -> float:
    """Return the share of rows of a gradient [N, K], dense or sparse, that are not all 0."""
    if gradient.is_sparse:
        values = gradient._values()
        listed = gradient._indices()[0][values.reshape(len(values), -1).any(1)]
        return len(listed.unique()) / max(len(gradient), 1)
    rows = gradient[:: max(len(gradient) // ROWS, 1)]
    return int(rows.any(1).sum()) / max(len(rows), 1)
