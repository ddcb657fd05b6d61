"""Octree-GS: Scaffold-GS with anchors on levels of detail."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.core.trainer_info import Densification


class OctreeGS(InriaFamily):
    """Anchors are grown and pruned before `update_until`, and levels are added until `coarse_iter`.

    With several resolution scales, an image has one camera and one mean per scale.
    """

    name = "octree_gs"
    checked = "city-super/Octree-GS 9db64fe (its script run)"
    project = "[Octree-GS](https://github.com/city-super/Octree-GS)"
    gated = "From `update_until` on, or with `progressive` from the end of `coarse_iter` on, whichever is later."
    left_alone = (
        "Networks and anchors have one optimizer, which is left alone. The mask of levels belongs to the forward."
    )
    stand_ins = "scaffold_gs"
    mark = "set_coarse_interval"
    needs = ("coarse_iter", "update_until")
    densification = Densification(marks=("update_interval",), needs="iterations")
    structural = ("prune_anchor", "training_setup")
    changes = ("adjust_anchor",)
    calls = (
        "eval",
        "get_anchor",
        "set_anchor_mask",
        "set_coarse_interval",
        "train",
        "training_statis",
    )
    arguments = ("retain_grad", "visible_mask")

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        coarse = int(opt.coarse_iter) + 1 if loop["dataset"].progressive else 0
        return max(int(opt.update_until), coarse)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.update_until)

    def view_key(self, camera: Any) -> Any:
        key, scale = super().view_key(camera), getattr(camera, "resolution_scale", 1.0)
        return key if key is None or scale == 1.0 else (key, scale)

    def view_keys(self, cameras: Sequence[Any]) -> list[Any]:
        return [self.view_key(camera) for camera in cameras]
