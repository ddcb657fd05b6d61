"""Speedy-Splat: goes on pruning after densification, with backward passes of its own that must all run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class SpeedySplat(InriaFamily):
    """`score_func` renders every view with `scores=` and runs a backward on it, within one iteration.

    Neither counts as training: another function than `training` calls that backward. The first hard prune is in the
    iteration in which densification ends, after its optimizer step.
    """

    name = "speedy_splat"
    checked = "j-alex-hanson/speedy-splat 6b523aa3 (its script run)"
    project = "[Speedy-Splat](https://github.com/j-alex-hanson/speedy-splat)"
    gated = (
        "From `densify_until_iter` + 1 on. Hard prunes happen at `densify_until_iter` and every `prune_interval` until "
        "the end. Each pauses the gate."
    )
    left_alone = "The backward passes for pruning scores always run."
    stand_ins = "speedy_splat"
    mark = "score_func"
    pausing = ("prune_gaussians",)
    arguments = ("scores",)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter) + 1

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        return kwargs.get("scores") is None and super().is_training_render(args, kwargs)
