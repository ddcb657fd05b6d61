"""Deformable 3D Gaussians: a network that moves the Gaussians with time, and learning rates set at the end."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

from skipgs_plug.adapters.inria import InriaFamily
from skipgs_plug.core.hooks import Hooks


class Deformable(InriaFamily):
    """Here `update_learning_rate` ends an iteration, so an iteration begins with the render of its view.

    The noise in the loop is input of the network and moves no Gaussian.
    """

    name = "deformable"
    checked = "ingra14m/Deformable-3D-Gaussians ac42372 (its loop read, and a look-alike: no stand-in)"
    project = "[Deformable 3D Gaussians](https://github.com/ingra14m/Deformable-3D-Gaussians)"
    gated = "From `densify_until_iter` on. Each frame of a video is a view with a mean of its own."
    left_alone = (
        "The optimizers of Gaussians and network have no gradients in skipped iterations. The noise on times goes on, "
        "since it is input of the network. Needs CUDA: `--cpu` has no stand-in for its rasterizer."
    )
    mark = "get_linear_noise_func"
    calls = ("randn",)

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        model = names["GaussianModel"]
        hooks.events(model, *(name for name in self.structural if hasattr(model, name)))

    def _attach_to_renderer(self, hooks: Hooks, names: dict[str, Any]) -> None:
        def rendered(original: Callable[..., Any], camera: Any, model: Any, *args: Any, **kwargs: Any) -> Any:
            if self.is_training_render(args, kwargs) and getattr(camera, "image_name", None) is not None:
                self._begins(hooks, model, sys._getframe(2))
                hooks.view(self.view_key(camera))
            return original(camera, model, *args, **kwargs)

        self._renderers(names)
        hooks.wrap(names, "render", rendered)
