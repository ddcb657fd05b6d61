"""gsplat's examples/simple_trainer.py: the `Runner` of PyPI 1.5.3 and of HEAD, DefaultStrategy and MCMCStrategy."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import torch

from skipgs_plug.adapters.base import GATES_SPAWNED, AbstractAdapter, refuse_other_processes
from skipgs_plug.adapters.gsplat_strategy import (
    first_iterations,
    iterations_that_run,
    leave_out_noise,
    strategy_events,
    survey_of,
)
from skipgs_plug.adapters.half_size_batches import show_half_size_batches
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode, function_names
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.source.functions import undecorated
from skipgs_plug.core.trainer_info import TrainerInfo
from skipgs_plug.host_copy import HostCopy

MODULE, RUNNER, LOOP = "gsplat.distributed", "Runner", "train"
START = f"call of {MODULE}.cli()"  # by it the script starts the function that trains
EXPECTED = ("cfg", "parser", "trainset", "rasterize_splats", "world_size")
BATCH = "batch"  # one key for the joint loss of random batches: a batch never comes up twice


class GsplatRunner(AbstractAdapter):
    """One iteration: render, `strategy.step_pre_backward`, backward, optimizers, `strategy.step_post_backward`.

    Optimizers are left alone: they set gradients to None. MCMC's noise is left out together with the gradient step. The
    strategy's methods are replaced on its class, since `train` writes the instance to a YAML file.
    """

    name = "gsplat"
    checked = "nerfstudio-project/gsplat v1.5.3 and v1.6.0 90d7b4b3 (its script run)"
    project = "[gsplat, `examples/simple_trainer.py`](https://github.com/nerfstudio-project/gsplat)"
    gated = "From `strategy.refine_stop_iter` on (15,000, for MCMC 25,000)."
    with_share = "By visits; with MCMC, all events are kept. Opacity resets happen as often as ever."
    left_alone = (
        "MCMC's position noise is left out together with the gradient step: alone it is a random walk. Batches of "
        "several images have one joint loss and so one mean. Once `--post_processing ppisp` freezes the Gaussians, all "
        "iterations run; `share`, `refine_share` and `compensate` are refused with it. No adapter knows gsplat's other "
        "example scripts (2DGS, driving, surgery). If the script spawns a process per GPU, `skipgs-plug run` attaches "
        "a gate in each. A backward is left out if all of them would leave it out (checked with gloo on the CPU, not "
        "on GPUs)."
    )
    stand_ins = "gsplat"

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._relocations = range(0)

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        strategy = getattr(getattr(trainer, "cfg", None), "strategy", None)
        return hasattr(strategy, "step_pre_backward") and hasattr(trainer, "rasterize_splats")

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return {RUNNER, MODULE} <= code.names  # simple_trainer_2dgs.py has no gsplat.distributed

    def attach_script(self, hooks: Hooks) -> None:
        def started(
            original: Callable[..., Any], rank: int, size: int, fn: Callable[..., Any], *args: Any, **kwargs: Any
        ) -> Any:
            if START in hooks.awaited:  # a second training run finds its Runner attached to, which releases the gate
                hooks.awaited.discard(START)
                function = undecorated(fn.func if isinstance(fn, functools.partial) else fn)
                names = {} if function is None else function.__globals__
                if RUNNER not in names:
                    expected = f"a class {RUNNER} among the names of the function that the script passes to cli()"
                    raise self.mismatch(expected)
                self.attach_on_call(hooks, names[RUNNER], LOOP)
            return original(rank, size, fn, *args, **kwargs)

        # Only the launcher attaches in each spawned process.
        if not getattr(torch.multiprocessing.spawn, GATES_SPAWNED, False):
            refuse_other_processes(hooks)
        hooks.gate_tensor_backward(LOOP)

        def imported(module: ModuleType) -> None:
            hooks.awaited.add(START)
            hooks.wrap(module, "_distributed_worker", started)

        when_imported(hooks, MODULE, imported)

    def attach(self, hooks: Hooks) -> None:
        runner = self.trainer
        missing = [name for name in EXPECTED if not hasattr(runner, name)]
        if not hasattr(getattr(runner, "cfg", None), "strategy"):  # gsplat before 1.3
            missing.append("cfg.strategy")
        if missing:
            raise self.mismatch(f"a Runner with {', '.join(missing)}")
        strategy = runner.cfg.strategy
        refuse_frozen(runner.cfg, hooks)
        survey = survey_of(self, LOOP, strategy)
        survey.read(runner.train, "step")
        batched = runner.cfg.batch_size > 1
        names = [BATCH] if batched else view_names(runner)
        # Id of the last rendered view. Its copy from the device starts before the render is launched.
        rendered: list[HostCopy] = []
        enabled = hooks.state.config.enabled

        def remember(*args: Any, image_ids: torch.Tensor | None = None, **kwargs: Any) -> None:
            if enabled and not batched and image_ids is not None and torch.is_grad_enabled():
                rendered[:] = [HostCopy(image_ids)]  # otherwise it is a render of the viewer or of an evaluation

        def forwarded(own: Any, *args: Any, step: int, **kwargs: Any) -> None:
            if own is strategy:
                hooks.iteration(step)
                if batched or not enabled:
                    hooks.view(BATCH)
                elif rendered:
                    view = rendered.pop()
                    hooks.view(lambda: names[int(view.value())])

        # At HEAD, a stage has held the bound method since the runner was built.
        stage = getattr(runner, "stage", None)
        hooks.before(*((runner, "rasterize_splats") if stage is None else (stage, "render")), remember)
        hooks.before(type(strategy), "step_pre_backward", forwarded)
        hooks.gate_tensor_backward(LOOP)
        hooks.loop(
            function_names(type(runner).train), LOOP, always=lambda numbers: iterations_that_run(strategy, numbers)
        )
        hooks.check_drift(lambda: runner.optimizers)
        self._relocations = leave_out_noise(hooks, strategy, type(strategy))
        self.output_folder = runner.cfg.result_dir
        last = runner.cfg.max_steps - 1
        start, read_until = first_iterations(survey, strategy, last)
        init_type = getattr(runner.cfg, "init_type", None)
        hooks.ready(
            TrainerInfo(
                start,
                view_names=names,
                epoch=iterations_per_epoch(runner),
                max_steps=last,
                world_size=runner.world_size,
                gradients_read_until=read_until,
                densification=None if survey.unknown else strategy_events(strategy),
                random_points=None if init_type is None else init_type == "random",
                photographs=None if survey.unknown else show_half_size_batches(hooks, runner),
            )
        )

    def must_run(self, step: int) -> bool:
        return step in self._relocations


def refuse_frozen(cfg: Any, hooks: Hooks) -> None:
    """Refuse to leave out iterations if the end of the run does not train the Gaussians.

    With `--post_processing ppisp` the script freezes the Gaussians near the end and distils a controller, which needs
    all its steps at their own length.

    Raises:
        SkipGSError: The run reaches that part, and iterations would be left out or steps scaled.
    """
    distils = getattr(cfg, "post_processing", None) == "ppisp" and cfg.ppisp_use_controller
    if not (distils and cfg.ppisp_controller_distillation):
        return
    begin, gate = cfg.ppisp_controller_activation_num_steps, hooks.state.config
    if begin < cfg.max_steps and (gate.leaves_out or gate.compensates):
        raise SkipGSError(
            f"From iteration {begin} on this run freezes the Gaussians and trains the PPISP controller, which needs "
            "every iteration at its own learning rate; gate without share, refine_share and compensate, or give the "
            "script --no-ppisp_controller_distillation."
        )


def iterations_per_epoch(runner: Any) -> int:
    """Return how many iterations show as many pixels as all training views have. They may show random patches."""
    views, side = len(runner.trainset), getattr(runner.cfg, "patch_size", None)
    sizes = list(getattr(runner.parser, "imsize_dict", {}).values()) if side else []  # width, height
    patches = [max(width / side, 1.0) * max(height / side, 1.0) for width, height in sizes]
    return math.ceil(views * (sum(patches) / len(patches) if patches else 1.0) / runner.cfg.batch_size)


def view_names(runner: Any) -> list[str]:
    """Image names of the training views, in the order of their ids."""
    names, indices = getattr(runner.parser, "image_names", None), getattr(runner.trainset, "indices", None)
    if names is None or indices is None:
        return [str(i) for i in range(len(runner.trainset))]
    return [names[i] for i in indices]
