"""Speedy-Splat: prunes on after densification, with backwards of its own that must all run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class SpeedySplat(InriaFamily):
    """`score_func` renders every view with `scores=` and runs a backward on it, in the midst of an iteration.

    Neither is taken for training: that backward is called by another function than `training`. Hard prunes
    begin in the very iteration in which densification ends, after its optimizer step.
    """

    name = "speedy_splat"
    checked = "j-alex-hanson/speedy-splat 6b523aa3 (its script, run on the CPU)"
    project = "[Speedy-Splat](https://github.com/j-alex-hanson/speedy-splat)"
    gated = (
        "From `densify_until_iter` + 1 on: a hard prune falls on `densify_until_iter` itself, and every "
        "`prune_interval` until the end, and each pauses the gate."
    )
    left_alone = "The backwards that compute pruning scores always run."
    stand_ins = "speedy_splat"
    mark = "score_func"
    calls = ("prune_gaussians",)
    arguments = ("scores",)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter) + 1

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        return kwargs.get("scores") is None and super().is_training_render(args, kwargs)
