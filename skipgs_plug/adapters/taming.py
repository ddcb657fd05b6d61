"""Taming 3DGS: two optimizers, of which one may accumulate, so only the backward is gated."""

from __future__ import annotations

from skipgs_plug.adapters.inria import RESETS, InriaFamily
from skipgs_plug.core.trainer_info import Densification


class Taming(InriaFamily):
    """Both optimizers keep their schedules. With `--sh_lower`, SH coefficients step every 16th iteration only.

    At `ho_iteration`, opacity becomes a plain tensor that renders the same image, so it is no event.
    """

    name = "taming"
    checked = "humansensinglab/taming-3dgs fd0f7d9e (its script run)"
    project = "[Taming 3DGS](https://github.com/humansensinglab/taming-3dgs)"
    gated = "From `densify_until_iter` on."
    left_alone = (
        "Both optimizers keep their schedules, with `--sh_lower` too. Freezing the opacity at `ho_iteration` changes "
        "no image and does not pause the gate."
    )
    stand_ins = "taming"
    mark = "get_count_array"
    changes = (*InriaFamily.changes, "densify_with_score")
    calls = ("modify_functions",)
    arguments = ("pixel_weights",)
    densification = Densification(marks=("densification_interval",), reset_marks=RESETS, needs="nothing")
