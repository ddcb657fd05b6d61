"""DashGaussian: train_dash.py, whose resolution rises while it densifies."""

from __future__ import annotations

from skipgs_plug.adapters.inria import RESETS, InriaFamily
from skipgs_plug.core.trainer_info import Densification


class DashGaussian(InriaFamily):
    """Resolution and number of Gaussians are scheduled until `densify_until_iter`, and constant from then on."""

    name = "dash_gaussian"
    checked = "YouyuChen0207/DashGaussian 4e3b5606 (train_dash.py run)"
    project = "[DashGaussian, `train_dash.py`](https://github.com/YouyuChen0207/DashGaussian)"
    gated = "From `densify_until_iter` on: resolution and number of Gaussians are constant."
    left_alone = (
        "The optimizers of Gaussians (sparse Adam too) and exposure have no gradients in skipped iterations. Its "
        "`train.py` is Inria's; use adapter `inria` for it."
    )
    stand_ins = "dash_gaussian"
    mark = "TrainingScheduler"
    changes = (*InriaFamily.changes, "prune_and_densify")
    arguments = ("render_size",)
    pure = ("get_res_scale",)  # it goes on to the level of its number, however many numbers are left out before
    densification = Densification(marks=("densification_interval",), reset_marks=RESETS, needs="nothing")
