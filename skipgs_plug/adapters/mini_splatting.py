"""Mini-Splatting: ms/train.py and ms_d/train.py, which sample and prune after densification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class MiniSplatting(InriaFamily):
    """Both simplifications change the model after the backward of their iteration, and make a new optimizer.

    So does ms_d/train.py in iteration `densify_until_iter`. Gaussians that views show blurred are gathered like
    gradients, until the next event. Points are recreated from depths every 5,000 iterations, with `share` too. The
    adapter counts iterations itself, since `update_learning_rate` gets shifted numbers.
    """

    name = "mini_splatting"
    checked = "fatPeter/mini-splatting c0d5581 (ms/train.py run; ms_d/train.py read)"
    project = "[Mini-Splatting](https://github.com/fatPeter/mini-splatting)"
    gated = (
        "`ms/train.py`: from `simp_iteration2` + 1 on, after a pause for the prune in that iteration. `ms_d/train.py`, "
        "which does not simplify: from `densify_until_iter` + 1 on."
    )
    with_share = (
        "By visits; blurred Gaussians are gathered until the next event. Points from depths and both simplifications "
        "happen as ever."
    )
    left_alone = "Scores and depths for pruning are rendered without gradients and always run."
    stand_ins = "gaussianspa"
    mark = "num_depth"
    needs = ("render_imp",)
    renders = ("render_imp",)
    structural = (*InriaFamily.structural, "reinitial_pts")
    changes = (*InriaFamily.changes, "densify_and_prune_split")

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        args = loop["args"]
        simplified = [getattr(args, name) + 1 for name in ("simp_iteration1", "simp_iteration2") if hasattr(args, name)]
        return max(int(opt.densify_until_iter) + 1, *map(int, simplified), 0)
