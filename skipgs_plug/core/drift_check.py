"""Check that nothing moves the model in skipped iterations."""

from __future__ import annotations

import torch
from torch import Tensor

from skipgs_plug.core import decision, distributed
from skipgs_plug.core.engine import Engine
from skipgs_plug.core.optimizers import Optimizers, has_pending_gradient, with_names

CHECKED_SKIPS = 5  # skipped iterations that are checked, from the second on; a loop repeats its changes


class DriftCheck:
    """Compares the parameters before and after skipped iterations without pending gradients or structural changes.

    A change there comes from the loop itself. It belongs to the gradient step, such as noise, and would go on alone.
    Sums and norms are compared. A checked iteration costs two passes over the parameters and one read of the device. A
    NaN that stays a NaN has not moved. Several ranks are not checked: one that gave up alone would leave the others
    waiting.

    Args:
        engine: The gate.
        optimizers: Returns the optimizers of all parameters that must not move, by name if their groups have no names.
    """

    def __init__(self, engine: Engine, optimizers: Optimizers) -> None:
        self._engine = engine
        self._optimizers = optimizers
        self._left = CHECKED_SKIPS
        # Number of structural changes, names, and sums of the parameters when the iteration began.
        self._before: tuple[int, list[str], list[Tensor]] | None = None

    def moved(self) -> list[str]:
        """Return the names of the parameters that moved in the iteration before this call, if it was skipped.

        Call it once at the beginning of each iteration, before the engine opens it.
        """
        stats = self._engine.stats
        if self._left == 0 or not stats.skips or distributed.group_size() > 1:
            return []
        before, self._before = self._before, None
        if self._engine.iteration.decision is decision.PAUSE:  # no iteration is skipped for a while
            return []
        named = with_names(self._optimizers())
        if any(has_pending_gradient(one) for _, one in named):
            return []
        changes = sum(stats.changes.values())
        names, now = _like(named)
        self._before = (changes, names, now)
        if before is None or not self._engine.skipped or before[0] != changes:
            return []
        self._left -= 1
        return _changed(before[1], before[2], now)


def _like(optimizers: list[tuple[str | None, torch.optim.Optimizer]]) -> tuple[list[str], list[Tensor]]:
    """Return for each parameter the name of its group or optimizer, or a number, and its sum and norm [2]."""
    names, sums = [], []
    for name, optimizer in optimizers:
        for index, group in enumerate(optimizer.param_groups):
            for param in group["params"]:
                values = param.detach()
                names.append(str(group.get("name", index if name is None else name)))
                sums.append(torch.stack([values.sum(), torch.linalg.vector_norm(values)]).double())
    return names, sums


def _changed(names: list[str], before: list[Tensor], after: list[Tensor]) -> list[str]:
    """Return the names of the parameters whose sums differ, each once. This reads each device once."""
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
