"""A look at the model in skipped iterations: nothing may move it there."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from skipgs_plug.core import decision
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.optimizers import has_pending_gradient

CHECKED_SKIPS = 5  # skipped iterations that are looked at, from the second on


class DriftCheck:
    """Compares the parameters before and after skipped iterations without pending gradients or events.

    What changes them there is something of the loop's own that belongs to the gradient step, such as noise, and
    would go on alone. Sums and norms are compared, which costs two passes over the parameters, no memory, and one read
    of the device in each skipped iteration that is looked at. A NaN that stays a NaN has not moved.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._left = CHECKED_SKIPS
        # Events so far, and what the parameters were like, when the iteration began.
        self._before: tuple[int, list[str], list[Tensor]] | None = None

    def moved(self, optimizers: Iterable[torch.optim.Optimizer]) -> list[str]:
        """Names of the parameters that the iteration which ends here moved, in an iteration that was skipped.

        To be called once at the beginning of each iteration, before `Hooks.iteration`.
        """
        stats = self._engine.stats
        if self._left == 0 or not stats.skips:
            return []
        before, self._before = self._before, None
        if self._engine.iteration.decision is decision.PAUSE:  # nothing is skipped for a while
            return []
        optimizers = list(optimizers)
        if any(map(has_pending_gradient, optimizers)):
            return []
        events = sum(stats.events.values())
        names, now = _like(optimizers)
        self._before = (events, names, now)
        if before is None or not self._engine.skipped or before[0] != events:
            return []
        self._left -= 1
        return _changed(before[1], before[2], now)


def _like(optimizers: list[torch.optim.Optimizer]) -> tuple[list[str], list[Tensor]]:
    """Name of the group of each parameter, and sum and norm of each parameter [2], where they lie."""
    names, sums = [], []
    for optimizer in optimizers:
        for index, group in enumerate(optimizer.param_groups):
            for param in group["params"]:
                values = param.detach()
                names.append(str(group.get("name", index)))
                sums.append(torch.stack([values.sum(), torch.linalg.vector_norm(values)]).double())
    return names, sums


def _changed(names: list[str], before: list[Tensor], after: list[Tensor]) -> list[str]:
    """Names, each once, of the parameters whose sums differ. One read for each device that holds parameters."""
    pairs = list(zip(names, before, after, strict=False))
    changed: list[str] = []
    for device in {old.device for old in before}:
        here = [(name, old, new) for name, old, new in pairs if old.device == new.device == device]
        if not here:
            continue
        old, new = torch.stack([old for _, old, _ in here]), torch.stack([new for _, _, new in here])
        differs = ((old != new) & ~(old.isnan() & new.isnan())).any(1).cpu().tolist()
        changed += [name for (name, _, _), moved in zip(here, differs, strict=True) if moved]
    return list(dict.fromkeys(changed))
