"""Perceptual-GS: trains sensitivities beside the scene until densification ends."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily


class PerceptualGS(InriaFamily):
    """The loss has a term on sensitivities up to and including `densify_until_iter`, which may rebuild the model.

    With images that have alpha, it prunes every hundredth iteration until the end. Each prune pauses the gate.
    """

    name = "perceptual_gs"
    checked = "eezkni/Perceptual-GS 991f196 (its script run)"
    project = "[Perceptual-GS](https://github.com/eezkni/Perceptual-GS)"
    gated = (
        "From `densify_until_iter` + 1 on, after a pause if iteration `densify_until_iter` rebuilds the model. With "
        "images that have alpha, a prune every hundredth iteration pauses the gate until the end."
    )
    with_share = (
        "By visits. Events that read weights of all views (every 1,000 and 1,500 iterations) are kept. With images "
        "that have alpha, all events are kept."
    )
    left_alone = "Renders of sensitivity and alpha show the same view and belong to its loss."
    stand_ins = "gaussianspa"
    mark = "get_sensitivity"
    structural = (*InriaFamily.structural, "reinitial_pts")
    calls = ("get_alpha", "get_sensitivity")

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        if all(getattr(camera, "alpha", None) is None for camera in loop["scene"].getTrainCameras()):
            self.known_names["gt_alpha"] = None

    def random_points(self, opt: Any, loop: Mapping[str, Any]) -> bool | None:
        # The loss of sensitivities lowers most opacities in the first steps, so they tell nothing. The script's own
        # reader of scenes makes random points where this folder is missing.
        source = getattr(loop.get("dataset"), "source_path", None)
        return None if source is None else not os.path.exists(os.path.join(source, "sparse"))

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter) + 1
