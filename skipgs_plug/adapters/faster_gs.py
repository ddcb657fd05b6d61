"""Faster-GS, a method of NeRFICG: callbacks around `training_iteration`."""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Iterator
from typing import Any

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo

MODULE, LOOP = "Methods.FasterGS.Trainer", "training_iteration"
EXPECTED = (LOOP, "renderer", "model", "DENSIFICATION_END_ITERATION", "NUM_ITERATIONS")
EVENTS = (
    "adaptive_density_control",
    "mcmc_densification",
    "reset_opacities",
    "importance_pruning",
)
# Methods of the Gaussians that callbacks run. Prunes by importance go on after densification, and pause the gate.
KNOWN = (
    "apply_morton_ordering",
    "compute_3d_filter",
    "importance_pruning",
    "increase_used_sh_degree",
    "post_optimizer_step",
    "prune",
    "reset_densification_info",
    "sort",
    "update_learning_rate",
)


class FasterGS(AbstractAdapter):
    """An iteration begins with `renderer.render_image_training(view=...)`, and counts from 0.

    The densification callback still runs in iteration `DENSIFICATION_END_ITERATION`, before its training step. MCMC's
    noise is left out together with the gradient step: alone it is a random walk.
    """

    name = "faster_gs"
    checked = "nerficg-project/faster-gaussian-splatting 3cb0b75 in NeRFICG c743712 (its loop read, and a look-alike)"
    project = "[Faster-GS](https://github.com/nerficg-project/faster-gaussian-splatting)"
    gated = (
        "From `DENSIFICATION_END_ITERATION` + 1 on. With Speedy-Splat's pruning, each later prune pauses the gate. The "
        "command, in the folder of NeRFICG: `skipgs-plug run faster_gs -- scripts/train.py -c config.yaml`."
    )
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = (
        "MCMC's position noise is left out together with the gradient step. Views are known by the number of their "
        "frame. Needs CUDA: `--cpu` has no stand-in."
    )

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return {"Framework", "DiscoverSourcePath"} <= code.names

    def attach_script(self, hooks: Hooks) -> None:
        gate_backwards_only(hooks, self)
        hooks.gate_tensor_backward(LOOP)
        when_imported(hooks, MODULE, lambda module: self.attach_on_call(hooks, module.FasterGSTrainer, "run"))

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        if not self.matches(trainer):
            raise self.mismatch(f"a FasterGSTrainer with {', '.join(EXPECTED)}")
        gate_backwards_only(hooks, self)

        def rendered(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            frame = sys._getframe(2)
            if frame.f_code.co_name == LOOP:
                with hooks.guarded():
                    hooks.iteration(frame.f_locals["iteration"])
                    hooks.view(int((kwargs["view"] if "view" in kwargs else args[0]).global_frame_idx))
            return original(*args, **kwargs)

        def stepped(original: Callable[..., Any], gaussians: Any, inject_noise: bool) -> Any:
            return original(gaussians, inject_noise=inject_noise and not hooks.state.skipped)

        gaussians = type(trainer.model.gaussians)
        survey = Survey(self, [gaussians], KNOWN, set(EVENTS) - set(KNOWN), [LOOP])
        for callback, ends in callbacks(trainer):
            survey.read(callback, "iteration", values={"self": trainer}, end=ends)
        hooks.wrap(trainer.renderer, "render_image_training", rendered)
        hooks.wrap(gaussians, "post_optimizer_step", stepped)
        hooks.events(gaussians, *(name for name in EVENTS if hasattr(gaussians, name)))
        hooks.gate_tensor_backward(LOOP)
        self.output_folder = str(trainer.output_directory) if hasattr(trainer, "output_directory") else None
        end, last = int(trainer.DENSIFICATION_END_ITERATION), int(trainer.NUM_ITERATIONS) - 1
        read_until = max(end, survey.end_of_gradients(end + 1, last))
        start = survey.start_after_changes(end + 1, last)
        hooks.ready(TrainerInfo(start, max_steps=last, gradients_read_until=read_until))


def callbacks(trainer: Any) -> Iterator[tuple[Callable[..., Any], int | None]]:
    """Yield the callbacks of a trainer that run during training, and the first iteration that is too late for each."""
    for name in dir(type(trainer)):
        callback = getattr(type(trainer), name, None)
        if callback is None or getattr(callback, "callback_type", None) != 0:
            continue
        active, end = (option(trainer, getattr(callback, key, None)) for key in ("active", "end_iteration"))
        yield callback, 0 if active is False else None if end is None else int(end) + 1


def option(trainer: Any, value: Any) -> Any:
    """Return the value of an option of a callback, which may be the name of one of the trainer's."""
    return operator.attrgetter(value)(trainer) if isinstance(value, str) else value
