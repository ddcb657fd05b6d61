"""PGSR: planes in place of Gaussians, with losses between neighbouring views."""

from __future__ import annotations

from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class PGSR(InriaFamily):
    """The loop renders a second view with gradients in the same iteration. The first view counts.

    The gate decides on the whole loss. Its geometric terms begin at iteration 7,000 and go on to the end.
    """

    name = "pgsr"
    checked = "zju3dv/PGSR de24f1a (its loop read, and a look-alike: its rasterizer has no stand-in)"
    project = "[PGSR](https://github.com/zju3dv/PGSR)"
    gated = "From `densify_until_iter` on; decided on the whole loss, with the terms between neighbouring views."
    left_alone = (
        "The optimizer of the appearance model has no gradients in skipped iterations either. Needs CUDA: `--cpu` has "
        "no stand-in for its rasterizer of planes."
    )
    mark = "get_points_depth_in_depth_map"
    calls = ("get_points_depth_in_depth_map", "get_points_from_depth")
    arguments = ("app_model", "return_depth_normal", "return_plane")

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._viewed: int | None = None  # iteration whose view is known

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        if not super().is_training_render(args, kwargs) or self._viewed == self._step:
            return False
        self._viewed = self._step
        return True
