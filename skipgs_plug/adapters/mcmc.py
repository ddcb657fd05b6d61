"""3DGS-MCMC: positions are noised in every iteration, inside the loop."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any

import torch

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.adapters.loop_code import LOOP
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import Densification

NOISE = "build_scaling_rotation"  # the loop calls it only for its noise


class MCMC(InriaFamily):
    """The noise belongs to the gradient step: alone it is a random walk.

    It is computed inside `training`, but its covariance comes from a function of another module. In skipped iterations
    that function returns zeros. The random numbers are drawn as usual. Relocation reads no gradients. A gate that
    starts before relocation ends runs the iterations that relocate.
    """

    name = "mcmc"
    checked = "ubc-vision/3dgs-mcmc 7b4fc9f7 (its script run)"
    project = "[3DGS-MCMC](https://github.com/ubc-vision/3dgs-mcmc)"
    gated = (
        "From `densify_until_iter` (25,000) on, when relocation has ended. A gate that you start earlier runs the "
        "iterations that relocate."
    )
    left_alone = "The position noise is zero in skipped iterations. Its random numbers are drawn as usual."
    stand_ins = "mcmc"
    shows_half_size = True
    mark = NOISE
    changes = (*InriaFamily.changes, "add_new_gs", "relocate_gs")
    calls = ("add_", "randn_like", "randn")
    densification = Densification(marks=("densification_interval",), needs="nothing", resets=False)

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._relocations = range(0)

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        interval = int(opt.densification_interval)
        first = int(opt.densify_from_iter) // interval * interval + interval
        self._relocations = range(first, int(opt.densify_until_iter), interval)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return 0

    def must_run(self, step: int) -> bool:
        return step in self._relocations

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        super()._attach_to_model(hooks, names)

        def covariance(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            factor = original(*args, **kwargs)
            # Frame 2 is the caller. The model calls it too, and needs its values.
            in_loop = sys._getframe(2).f_code.co_name == LOOP
            return torch.zeros_like(factor) if in_loop and hooks.state.skipped else factor

        hooks.wrap(names, NOISE, covariance)
