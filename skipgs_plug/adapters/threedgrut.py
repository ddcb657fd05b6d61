"""3DGRUT: `Trainer3DGRUT` for 3DGRT and 3DGUT, with the strategies GS and MCMC."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo

MODULE, STEP = "threedgrut.trainer", "run_train_iter"
EXPECTED = (STEP, "run_training", "strategy", "train_dataset", "conf")
# Sections of the strategy's configuration that change the number or density of Gaussians.
CHANGES = (
    "densify",
    "prune",
    "prune_weight",
    "prune_scale",
    "density_decay",
    "reset_density",
    "relocate",
    "add",
)
WINDOW = "check_step_condition"  # tells whether a step lies between two others
EVENTS = (
    "densify_gaussians",
    "prune_gaussians_opacity",
    "prune_gaussians_scale",
    "prune_gaussians_weight",
    "reset_density",
    "decay_density",
    "relocate_gaussians",
    "add_new_gaussians",
)
# Further methods of strategy and model that the loop and the strategy run.
KNOWN = (
    "build_acc",
    "clamp_density",
    "clone",
    "freeze_gaussians",
    "increase_num_active_features",
    "perturb_gaussians",
    "scheduler_step",
    "suspend",
    "trace",
    "update_gradient_buffer",
)
# The loop calls these, and they decide by the step.
STAGES = ("pre_backward", "post_backward", "post_optimizer_step")
THROUGH = (*STAGES, *(f"_{name}" for name in STAGES))


class ThreeDGRUT(AbstractAdapter):
    """One iteration is `run_train_iter(global_step, ...)`, from 0. The strategy gets the view before the backward.

    MCMC's `perturb_gaussians` is left out together with the gradient step: alone it is a random walk.
    """

    name = "3dgrut"
    checked = "nv-tlabs/3dgrut a37ef72 (its loop read, and a look-alike)"
    project = "[3DGRUT](https://github.com/nv-tlabs/3dgrut)"
    gated = "From the last `end_iteration` of the strategy on: it no longer densifies, prunes or resets."
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = (
        "MCMC's position noise is left out together with the gradient step. Views are known by image path, or by frame "
        "if the dataset has no paths. Its loops run over epochs and a DataLoader. Needs CUDA."
    )

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return code.leaves_training_to("threedgrut")

    def attach_script(self, hooks: Hooks) -> None:
        gate_backwards_only(hooks, self)
        hooks.gate_tensor_backward(STEP)
        when_imported(hooks, MODULE, lambda module: self.attach_on_call(hooks, module.Trainer3DGRUT, "run_training"))

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        if not self.matches(trainer):
            raise self.mismatch(f"a Trainer3DGRUT with {', '.join(EXPECTED)}")
        gate_backwards_only(hooks, self)
        paths = getattr(trainer.train_dataset, "image_paths", None)
        names = None if paths is None else [str(path) for path in paths]

        def stepped(original: Callable[..., Any], global_step: int, *args: Any, **kwargs: Any) -> Any:
            with hooks.guarded():
                hooks.iteration(global_step)
            return original(global_step, *args, **kwargs)

        def told(*args: Any, batch: Any = None, **kwargs: Any) -> None:
            if batch is not None and batch.frame_idx >= 0:
                hooks.view(int(batch.frame_idx) if names is None else names[int(batch.frame_idx)])

        strategy = trainer.strategy
        survey = Survey(self, [type(strategy), type(trainer.model)], KNOWN, EVENTS, [STEP], THROUGH, [WINDOW])
        survey.read(getattr(trainer, STEP), "global_step")
        hooks.wrap(trainer, STEP, stepped)
        hooks.before(strategy, "pre_backward", told)
        hooks.events(strategy, *(name for name in EVENTS if hasattr(strategy, name)))
        if hasattr(strategy, "perturb_gaussians"):
            hooks.suppress_on_skip(strategy, "perturb_gaussians")
        hooks.gate_tensor_backward(STEP)
        self.output_folder = getattr(getattr(trainer, "tracking", None), "output_dir", None)
        end, last = last_change(trainer.conf.strategy), int(trainer.conf.n_iterations) - 1
        read_until = max(end, survey.end_of_gradients(end, last))
        start = survey.start_after_changes(end, last)
        hooks.ready(TrainerInfo(start, view_names=names, max_steps=last, gradients_read_until=read_until))


def last_change(strategy: Any) -> int:
    """Return the first step after all changes of Gaussians that this configuration ends."""
    sections = [getattr(strategy, name) for name in CHANGES if getattr(strategy, name, None) is not None]
    ends = [int(one.end_iteration) for one in sections if one.start_iteration >= 0 and one.end_iteration >= 0]
    return max(ends, default=0)
