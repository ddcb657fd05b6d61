"""EDGS: correspondences in place of densification, in a trainer object around Inria 3DGS."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_bounds import ASSIGNED
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import CALLS, Survey
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo
from skipgs_plug.core.views import view_key

MODULE, STEP = "source.trainer", "train_step_gs"
EXPECTED = (STEP, "train", "GS", "gs_step", "training_config", "scene")
EVENTS = ("prune_points", "reset_opacity", "training_setup")
CHANGES = (*EVENTS, "densify_and_prune", ASSIGNED)  # with `reduce_opacity` the loop assigns to opacities


class EDGS(AbstractAdapter):
    """One iteration is `train_step_gs`: learning rates, forward of `GS`, backward, step. Then it densifies or prunes.

    With `no_densify` it prunes after every iteration before `densify_until_iter`. The last prune pauses the gate.
    """

    name = "edgs"
    checked = "CompVis/EDGS eb21ad5 (its loop read, and a look-alike)"
    project = "[EDGS](https://github.com/CompVis/EDGS)"
    gated = "From `gs.opt.densify_until_iter` on. Until then it densifies, or prunes after every iteration."
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = "Its loop counts with tqdm's `trange`. Needs CUDA, since a network matches images at the start."

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return "EDGSTrainer" in code.names

    def attach_script(self, hooks: Hooks) -> None:
        gate_backwards_only(hooks, self)
        hooks.gate_tensor_backward(STEP)
        when_imported(hooks, MODULE, lambda module: self.attach_on_call(hooks, module.EDGSTrainer, "train"))

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        if not self.matches(trainer):
            raise self.mismatch(f"an EDGSTrainer with {', '.join(EXPECTED)}")
        gate_backwards_only(hooks, self)

        def stepped(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            with hooks.guarded():
                hooks.iteration(trainer.gs_step + 1)
            return original(*args, **kwargs)

        def rendered(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            camera = kwargs.get("viewpoint_cam", args[0] if args else None)
            if torch.is_grad_enabled() and camera is not None:
                hooks.view(camera.image_name)
            return original(*args, **kwargs)

        gaussians = type(trainer.GS.gaussians)
        survey = Survey(self, [gaussians], CALLS, CHANGES, [STEP])
        survey.read(trainer.train, "self.gs_step", "self.training_step")
        hooks.wrap(trainer, STEP, stepped)
        hooks.wrap(trainer.GS, "forward", rendered)
        hooks.events(gaussians, *(name for name in EVENTS if hasattr(gaussians, name)))
        hooks.gate_tensor_backward(STEP)
        self.output_folder = getattr(trainer.scene, "model_path", None)
        end = int(trainer.training_config.densify_until_iter)
        views = [view_key(camera.image_name) for camera in trainer.scene.getTrainCameras()]
        read_until = max(end, survey.end_of_gradients(end))
        hooks.ready(TrainerInfo(survey.start_after_changes(end), view_names=views, gradients_read_until=read_until))
