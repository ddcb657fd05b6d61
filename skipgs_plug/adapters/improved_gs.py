"""Improved-GS: gradients accumulate over 5 and 20 iterations, so only the backward may be gated."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from skipgs_plug.adapters.inria import GROWS_WHOLE, RESETS, InriaFamily
from skipgs_plug.core.trainer_info import Densification


class ImprovedGS(InriaFamily):
    """Both optimizers step every 5th iteration from 15,001 on and every 20th from 22,501 on, as upstream.

    They are called in skipped iterations too, and may apply gradients of earlier iterations there. With a tenth of
    densification bonsai (100x67, 255 views, 30,000 iterations) lost 1.6 dB; with all of it, and a fifth of refinement,
    it loses nothing.
    """

    name = "improved_gs"
    checked = "XiaoBin2001/Improved-GS d008d118 (its script run)"
    project = "[Improved-GS](https://github.com/XiaoBin2001/Improved-GS)"
    gated = "From `densify_until_iter` on."
    left_alone = (
        "Both optimizers step every 5th and later every 20th iteration with the gradients gathered since, even in a "
        "skipped iteration."
    )
    with_share = f"All events are kept. {GROWS_WHOLE}"
    stand_ins = "improved_gs"
    mark = "compute_edge_score"
    needs = ("optimizer_type",)
    changes = (*InriaFamily.changes, "densify_and_prune_Improved")
    calls: ClassVar[tuple[str, ...]] = ("add_densification_stats_abs",)
    arguments = ("pixel_weights",)
    densification = Densification(marks=("densification_interval",), reset_marks=RESETS, needs="nothing")
    structural = (*InriaFamily.structural, "only_prune")
    accumulates_from: ClassVar[int] = 15_000  # iteration; a constant of the loop

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        return opt.optimizer_type == "default" and self.start_iter(opt, loop) >= self.accumulates_from
