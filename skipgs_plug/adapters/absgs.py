"""AbsGS: Inria's loop with absolute gradients, and prunes by blend weight that go on after densification."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class AbsGS(InriaFamily):
    """With `--use_prune_weight` it prunes once per round of the views until `prune_until_iter`.

    A pause for a prune lasts at least one round of the views, so the gate begins after the last prune.
    """

    name = "absgs"
    checked = "TY424/AbsGS 87d7a5aa (its script run)"
    project = "[AbsGS](https://github.com/TY424/AbsGS)"
    gated = "From `densify_until_iter` on, with `--use_prune_weight` from `prune_until_iter` on."
    left_alone = "Blend weights are gathered in skipped iterations too, since they come from the forward."
    stand_ins = "absgs"
    mark = "use_prune_weight"
    needs = ("prune_until_iter",)
    changes = (*InriaFamily.changes, "reduce_opacity")
    calls = ("initial_prune",)

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        # The loop counts its views in its first iteration.
        self.known_names["img_num"] = len(loop["scene"].getTrainCameras())

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return max(int(opt.densify_until_iter), int(opt.prune_until_iter) if opt.use_prune_weight else 0)
