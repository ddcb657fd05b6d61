"""GNS: Improved-GS with natural selection by opacity, which prunes for 8,000 iterations after densification."""

from __future__ import annotations

import ast
import math
from collections.abc import Iterable, Mapping
from typing import Any

from skipgs_plug.adapters.improved_gs import ImprovedGS
from skipgs_plug.adapters.inria import GROWS_WHOLE
from skipgs_plug.core.hooks import Hooks

PRUNED = "prune_iter"  # the loop's variable for the iteration of the final prune


class GNS(ImprovedGS):
    """Gated after the selection, in which a term of the loss pushes opacities of Gaussians to zero.

    The final prune comes early if few enough Gaussians are left. Both optimizers step every 5th and later every 20th
    iteration. They are called in skipped iterations too, and may apply gradients of earlier iterations there. With
    `share`, all iterations of the selection run: its term would act alone if iterations between were left out. The loop
    lowers the rate of opacities again, a fixed number of iterations after the final prune.
    """

    name = "gns"
    checked = "XiaoBin2001/GNS 0c8e7dcd (train.py run; train-fast.py read)"
    project = "[GNS](https://github.com/XiaoBin2001/GNS)"
    gated = (
        "`train.py`: from `reg_end` + 1 (23,001) on, after the selection by opacity, or without `prune_reg` from "
        "`densify_until_iter` on. `train-fast.py`: from `e2` + 1 (10,001) on."
    )
    with_share = (
        "All events are kept. All iterations of the selection run: its term would act alone if iterations between "
        f"were left out. {GROWS_WHOLE}"
    )
    mark = "update_opacity_lr"
    changes = (*ImprovedGS.changes, "final_prune")
    calls = (*ImprovedGS.calls, "update_opacity_lr")
    accumulates_from = 20_000

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._selection: list[range] = []

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        self.known_names[PRUNED] = math.inf  # the condition never holds: the final prune requires its iteration
        if self._fast:
            self._selection = [range(int(opt.s1), int(opt.e1) + 1), range(int(opt.s2), int(opt.e2) + 1)]
        elif opt.prune_reg:
            self._selection = [range(int(opt.reg_start), int(opt.reg_end) + 1)]

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return the iterations of the selection."""
        return (n for n in numbers if any(n in one for one in self._selection))

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        super()._attach_to_model(hooks, names)

        def pruned(*args: Any, **kwargs: Any) -> None:
            hooks.event("final_prune")
            syntax = None if self._code is None else self._code.syntax
            for delay in () if syntax is None else delays(syntax):
                hooks.require(self._step + delay)

        hooks.before(names["GaussianModel"], "final_prune", pruned)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        if self._fast:
            return int(opt.e2) + 1
        return max(int(opt.densify_until_iter), int(opt.reg_end) + 1 if opt.prune_reg else 0)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.s2) if self._fast else int(opt.densify_until_iter)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        return super().accumulates(opt, loop) or (self._fast and opt.optimizer_type == "default")

    @property
    def _fast(self) -> bool:
        """Whether the script is train-fast.py, which has two shorter selections of its own."""
        return self._code is not None and "s2" in self._code.used


def delays(loop: ast.FunctionDef) -> Iterable[int]:
    """Yield numbers of iterations after the final prune that the loop asks for: `iteration == prune_iter + 1000`."""
    for node in ast.walk(loop):
        match node:
            case ast.BinOp(ast.Name(name), ast.Add(), ast.Constant(int(delay))) if name == PRUNED:
                yield delay
