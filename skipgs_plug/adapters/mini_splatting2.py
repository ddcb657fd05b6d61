"""Mini-Splatting2: msv2/train.py and msv2_d/train.py, which cull Gaussians per view until late."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class MiniSplatting2(InriaFamily):
    """Half-way between its second simplification and the end, all culled Gaussians return to their views.

    Losses change there, so the gate begins after it. Clones by importance happen every 250 iterations, with `share`
    too: they read no statistics of the loop.
    """

    name = "mini_splatting2"
    checked = "fatPeter/mini-splatting2 5ec9202 (both loops read, and a look-alike)"
    project = "[Mini-Splatting2](https://github.com/fatPeter/mini-splatting2)"
    gated = (
        "From the iteration after (`simp_iteration2` + `iterations`) // 2 on, in which culled Gaussians return to "
        "their views, after a pause."
    )
    with_share = (
        "By visits. Clones by importance every 250 iterations, points from depths and simplifications happen as ever."
    )
    left_alone = "Its sparse Adam has no gradients in skipped iterations. Needs CUDA: its culling has no stand-in."
    mark = "depth_reinit"
    needs = ("render_imp", "simp_iteration2")
    renders = ("render_imp",)
    structural = (*InriaFamily.structural, "reinitial_pts", "init_culling")
    changes = (
        *InriaFamily.changes,
        "culling_with_clone",
        "culling_with_importance_pruning",
        "culling_with_interesction_preserving",
        "culling_with_interesction_sampling",
        "densify_and_prune_mask",
        "extend_features_rest",
        "interesction_preserving",
    )
    calls = ("add_densification_stats_culling", "depth_reinit")
    arguments = ("culling",)

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return max((int(loop["args"].simp_iteration2) + int(opt.iterations)) // 2 + 1, int(opt.densify_until_iter))
