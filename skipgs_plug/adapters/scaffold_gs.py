"""Scaffold-GS: small networks make Gaussians from anchors, anew for each view."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.core.trainer_info import Densification


class ScaffoldGS(InriaFamily):
    """Anchors are grown and pruned before `update_until`; networks are parameters of the same optimizer."""

    name = "scaffold_gs"
    checked = "city-super/Scaffold-GS 59c833b5 (its script run)"
    project = "[Scaffold-GS](https://github.com/city-super/Scaffold-GS)"
    gated = "From `update_until` on: anchors are no longer grown or pruned."
    left_alone = "Networks and anchors have one optimizer, which is left alone."
    stand_ins = "scaffold_gs"
    mark = "training_statis"  # `prefilter_voxel` is none: Spec-Gaussian culls plain Gaussians with it
    needs = ("update_until",)
    changes = ("adjust_anchor",)
    calls = ("eval", "get_anchor", "train", "training_statis")
    arguments = ("retain_grad", "visible_mask")
    densification = Densification(marks=("update_interval",), needs="iterations")
    structural = ("prune_anchor", "training_setup")

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.update_until)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.update_until)
