"""nerfstudio's `Trainer` with splatfacto, splatfacto-mcmc, or a method of others that derives from them."""

from __future__ import annotations

import ast
import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from skipgs_plug.adapters.base import AbstractAdapter, refuse_other_processes
from skipgs_plug.adapters.gsplat_strategy import (
    first_iterations,
    iterations_that_run,
    leave_out_noise,
    strategy_events,
    survey_of,
)
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode, function_names
from skipgs_plug.core.caution import caution
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.source.conditions import is_point, leaves
from skipgs_plug.core.source.functions import syntax_of, undecorated
from skipgs_plug.core.source.milestones import BY_ALWAYS
from skipgs_plug.core.trainer_info import TrainerInfo

MODULE = "nerfstudio.engine.trainer"
LOOP = "train_iteration"
CALLBACKS = ("step_cb", "step_post_backward")  # methods of splatfacto that the trainer calls


class Nerfstudio(AbstractAdapter):
    """Attach after `trainer.setup()`. The gate decides on `main_loss`, since other terms come in some iterations only.

    nerfstudio steps an optimizer only with a pending gradient, so optimizers and schedulers are left alone.
    """

    name = "nerfstudio"
    checked = "nerfstudio-project/nerfstudio 1.1.5 50e0e3c7 (ns-train run)"
    project = "[nerfstudio, splatfacto and splatfacto-mcmc](https://github.com/nerfstudio-project/nerfstudio)"
    gated = (
        "Like gsplat, by `main_loss`: other terms come every tenth iteration. Models that densify themselves "
        "(before 1.1.5): after their last gradient."
    )
    with_share = (
        "Like gsplat. All iterations until `stop_screen_size_at`, evaluations, and the first and last iteration of "
        "accumulated gradients always run."
    )
    left_alone = (
        "`skipgs-plug run nerfstudio -- ns-train splatfacto ...` (or `-m nerfstudio.scripts.train`). "
        "`skipgs.json` lies beside its `config.yml`."
    )
    stand_ins = "nerfstudio"

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._relocations = range(0)

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return hasattr(trainer, LOOP) and hasattr(trainer, "grad_scaler")

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return code.leaves_training_to("nerfstudio")

    def attach_script(self, hooks: Hooks) -> None:
        refuse_other_processes(hooks)
        hooks.gate_tensor_backward(LOOP)
        when_imported(hooks, MODULE, lambda module: self.attach_on_call(hooks, module.Trainer, "train"))

    def attach(self, hooks: Hooks) -> None:
        trainer = self.trainer
        pipeline = getattr(trainer, "pipeline", None)
        if pipeline is None or not hasattr(trainer, LOOP):
            raise self.mismatch(f"a Trainer with {LOOP}() whose setup() was called")
        names = view_names(pipeline.datamanager.train_dataset.image_filenames)

        def forwarded(original: Callable[..., Any], step: int) -> Any:
            hooks.iteration(step)
            outputs, losses, metrics = original(step=step)
            if "main_loss" in losses:
                hooks.signal(losses["main_loss"])
            return outputs, losses, metrics

        def batch_made(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            camera, batch = original(*args, **kwargs)
            if "image_idx" in batch:
                index = batch["image_idx"]
                hooks.view(lambda: names[int(index)])
            return camera, batch

        strategy = getattr(pipeline.model, "strategy", None)
        survey = survey_of(self, LOOP, strategy, type(pipeline.model), through=CALLBACKS)
        survey.read(trainer.train, "step")
        for callback, end in callbacks(trainer):
            survey.read(callback, "step", "self.step", end=end)
        if hooks.state.config.leaves_out and hooks.state.config.always is None:
            warn_of_conditions(pipeline.get_train_loss_dict, pipeline.datamanager.next_train)
        hooks.wrap(pipeline, "get_train_loss_dict", forwarded)
        hooks.wrap(pipeline.datamanager, "next_train", batch_made)
        hooks.gate_tensor_backward(LOOP)
        hooks.loop(function_names(type(trainer).train), "train", always=self.always_run, pure=("step_check",))
        hooks.optimizer_names(lambda: trainer.optimizers.optimizers)
        hooks.check_drift(lambda: trainer.optimizers.optimizers)
        self._relocations = leave_out_noise(hooks, strategy, strategy)
        self.output_folder = getattr(trainer, "base_dir", None)
        last = trainer.config.max_num_iterations - 1
        start, read_until = first_iterations(survey, strategy, last)
        hooks.ready(
            TrainerInfo(
                start,
                view_names=names,
                max_steps=last,
                world_size=trainer.world_size,
                gradients_read_until=read_until,
                densification=None if survey.unknown else strategy_events(strategy),
                random_points=begins_at_random(pipeline.model),
            )
        )

    def must_run(self, step: int) -> bool:
        return step in self._relocations

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return evaluations, calls of callbacks by number, and first and last iterations of accumulated gradients.

        The loop does not show them.
        """
        config = self.trainer.config
        every = (config.steps_per_eval_batch, config.steps_per_eval_image, config.steps_per_eval_all_images)
        gathered = [steps for steps in config.gradient_accumulation_steps.values() if steps > 1]
        yield from iterations_that_run(getattr(self.trainer.pipeline.model, "strategy", None), numbers)
        for n in numbers:
            evaluates = any(interval and n % interval == 0 for interval in every)
            calls = any(called_at(callback, n) for callback in self.trainer.callbacks)
            if evaluates or calls or any(n % steps in (0, steps - 1) for steps in gathered):
                yield n


def called_at(callback: Any, step: int) -> bool:
    """Whether a callback names an iteration by its interval or in its list; in a list without gaps, none is named."""
    every, steps = getattr(callback, "update_every_num_iters", None), getattr(callback, "iters", None)
    if every is not None:
        return every > 1 and step % every == 0
    return steps is not None and step in steps and not {step - 1, step + 1}.intersection(steps)


def warn_of_conditions(*functions: Callable[..., Any]) -> None:
    """Warn of conditions on the iteration's number in functions that nerfstudio calls, which are not read ahead.

    nerfstudio itself has none there. Methods that edit their images in some iterations have.
    """
    for plain in filter(None, map(undecorated, functions)):
        syntax = syntax_of(plain)
        tests = [node.test for node in ast.walk(syntax) if isinstance(node, ast.If)] if syntax is not None else []
        for leaf in (leaf for test in tests for leaf in leaves(test)):
            by_number = any(isinstance(part, ast.Name) and part.id == "step" for part in ast.walk(leaf))
            if by_number and isinstance(leaf, (ast.BinOp, ast.Compare)) and is_point(leaf):
                caution(
                    f"{plain.__qualname__}() has a condition on the iteration's number that is not read "
                    f"({ast.unparse(leaf)}), so iterations that it needs could be left out; {BY_ALWAYS}."
                )


def callbacks(trainer: Any) -> Iterator[tuple[Callable[..., Any], int | None]]:
    """Yield the functions that the trainer calls around iterations, and the first step that is too late for each."""
    for callback in trainer.callbacks:
        steps = getattr(callback, "iters", None)
        yield getattr(callback, "func", callback), None if steps is None else max(steps, default=-1) + 1


def begins_at_random(model: Any) -> bool | None:
    """Return whether a Splatfacto model begins with random points: it was told to, or the scene has no points.

    The answer is None if the model does not say which points it was given.
    """
    if getattr(getattr(model, "config", None), "random_init", False):
        return True
    return model.seed_points is None if hasattr(model, "seed_points") else None


def view_names(files: list[Path]) -> list[str]:
    """Return image paths relative to the folder that holds all of them."""
    root = os.path.commonpath([file.parent for file in files])
    return [file.relative_to(root).as_posix() for file in files]
