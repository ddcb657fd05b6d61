"""GNS: Improved-GS with natural selection by opacity, which prunes for 8,000 iterations after densification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.core.facts import Densification

ACCUMULATES_FROM = 20_000  # train.py has this number in it


class GNS(InriaFamily):
    """Gated after the selection, whose loss has a term on opacities that drives Gaussians out.

    The final prune may come earlier, as soon as few enough are left. Both optimizers step every 5th and later every
    20th iteration. They are called in skipped iterations too, where they may have gradients of earlier ones to apply.
    """

    name = "gns"
    checked = "XiaoBin2001/GNS 0c8e7dcd (train.py run on the CPU; train-fast.py read)"
    project = "[GNS](https://github.com/XiaoBin2001/GNS)"
    gated = (
        "`train.py`: from `reg_end` + 1 (23,001) on, where selection by opacity has ended; without `prune_reg` from "
        "`densify_until_iter` on. `train-fast.py`: from `e2` + 1 (10,001) on."
    )
    left_alone = (
        "Both optimizers step every 5th and later every 20th iteration on what the backwards since then have left, in "
        "skipped iterations too."
    )
    stand_ins = "improved_gs"
    mark = "update_opacity_lr"
    densification = Densification(marks=("densification_interval",), needs="nothing")
    structural = (*InriaFamily.structural, "only_prune", "final_prune")
    calls = ("add_densification_stats_abs", "densify_and_prune_Improved", "update_opacity_lr")
    arguments = ("pixel_weights",)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        if self._fast:
            return int(opt.e2) + 1
        return max(int(opt.densify_until_iter), int(opt.reg_end) + 1 if opt.prune_reg else 0)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.s2) if self._fast else int(opt.densify_until_iter)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        return opt.optimizer_type == "default" and (self._fast or self.start_iter(opt, loop) >= ACCUMULATES_FROM)

    @property
    def _fast(self) -> bool:
        """Whether the script is train-fast.py, which has two shorter selections of its own."""
        return self._code is not None and "s2" in self._code.used
