"""fVDB Reality Capture: the `SceneOptimizationRunner` of old scripts, the `GaussianSplatReconstruction` of `frgs`."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, NamedTuple

import torch

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo


class Runner(NamedTuple):
    """Class of fVDB that holds a training loop.

    Attributes:
        module: Module of the class.
        name: Name of the class.
        loop: Method that holds the loop.
        counts_views: Whether an epoch has as many steps as views, in batches of several views too.
    """

    module: str
    name: str
    loop: str
    counts_views: bool


PACKAGE = "fvdb_reality_capture"
OLD = Runner(f"{PACKAGE}.training.scene_optimization_runner", "SceneOptimizationRunner", "train", True)
FRGS = Runner(
    f"{PACKAGE}.radiance_fields.gaussian_splat_reconstruction", "GaussianSplatReconstruction", "optimize", False
)
EXPECTED = ("config", "training_dataset", "optimizer", "model", "_global_step", "_start_step")
BATCH = "batch"  # one key for the joint loss of random batches
EVENTS = ("refine_gaussians", "reset_opacities", "remove_gaussians", "refine", "filter_gaussians")
KNOWN = ("step", "zero_grad", "state_dict", "regularization_loss")  # further methods of the optimizer that loops run
NOISE = "add_noise_to_means"


class FVDB(AbstractAdapter):
    """An iteration begins when the loop takes a minibatch of its training set, at step `_global_step` (counted from 0).

    Its optimizer steps torch optimizers that do nothing without a gradient. MCMC's noise is left out together with the
    gradient step: alone it is a random walk.
    """

    name = "fvdb"
    checked = "openvdb/fvdb-reality-capture 0761837 and 0.6.0 of PyPI (their loops read, and look-alikes)"
    project = "[fVDB Reality Capture](https://github.com/openvdb/fvdb-reality-capture)"
    gated = (
        "From epoch `refine_stop_epoch` on, or from `pose_opt_stop_epoch` on if it is later and camera poses are "
        "optimized. Before `frgs`, opacities were reset until the end; each reset pauses the gate."
    )
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = (
        "The command: `skipgs-plug run fvdb -- frgs reconstruct ...`. MCMC's position noise is left out together with "
        "the gradient step. Batches of several images have one mean. Several crops per image are refused. Needs CUDA."
    )

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return _runner_of(trainer) is not None and all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return code.leaves_training_to(PACKAGE)

    def attach_script(self, hooks: Hooks) -> None:
        gate_backwards_only(hooks, self)
        hooks.gate_tensor_backward(OLD.loop, FRGS.loop)
        for runner in (OLD, FRGS):
            when_imported(hooks, runner.module, functools.partial(self._attach_to_class, hooks, runner))

    def _attach_to_class(self, hooks: Hooks, runner: Runner, module: ModuleType) -> None:
        self.attach_on_call(hooks, getattr(module, runner.name), runner.loop)

    def attach(self, hooks: Hooks) -> None:
        runner, kind = self.trainer, _runner_of(self.trainer)
        if kind is None or not self.matches(runner):
            raise self.mismatch(f"a {OLD.name} or {FRGS.name} with {', '.join(EXPECTED)}")
        gate_backwards_only(hooks, self)
        config, dataset = runner.config, runner.training_dataset
        if config.crops_per_image != 1:
            raise SkipGSError(
                f"crops_per_image is {config.crops_per_image}, and each crop has a backward of its own; set it to 1."
            )
        batched = config.batch_size > 1

        def iterated(original: Callable[..., Any], loader: Any) -> Iterator[Any]:
            if loader.dataset is not dataset:
                return original(loader)
            return minibatches(original(loader))

        def minibatches(batches: Iterator[Any]) -> Iterator[Any]:
            for minibatch in batches:
                # SceneOptimizationRunner takes all minibatches again if it is resumed, and passes over old ones.
                if runner._global_step >= runner._start_step or not kind.counts_views:
                    with hooks.guarded():
                        hooks.iteration(runner._global_step)
                        ids = minibatch["image_id"]
                        hooks.view(BATCH if batched else lambda ids=ids: int(ids[0]))
                yield minibatch

        hooks.wrap(torch.utils.data.DataLoader, "__iter__", iterated)
        optimizer = runner.optimizer
        hooks.events(optimizer, *(name for name in EVENTS if hasattr(optimizer, name)))
        if hasattr(type(runner.model), NOISE):
            hooks.suppress_on_skip(type(runner.model), NOISE)
        hooks.gate_tensor_backward(kind.loop)
        self.output_folder = _output_folder(runner)
        steps = len(dataset) if kind.counts_views else math.ceil(len(dataset) / config.batch_size)
        end = int(config.refine_stop_epoch * steps)
        if config.optimize_camera_poses:
            end = max(end, int(config.pose_opt_stop_epoch * steps))
        survey = Survey(self, [type(optimizer)], KNOWN, EVENTS, [kind.loop])
        survey.read(getattr(runner, kind.loop), "self._global_step")
        last = math.inf if config.max_steps is None else config.max_steps
        read_until = max(end, survey.end_of_gradients(end, last))
        start = survey.start_after_changes(end, last)
        hooks.ready(TrainerInfo(start, max_steps=config.max_steps, gradients_read_until=read_until))


def _runner_of(trainer: Any) -> Runner | None:
    return next((one for one in (OLD, FRGS) if callable(getattr(trainer, one.loop, None))), None)


def _output_folder(runner: Any) -> str | None:
    """Return the folder of checkpoints; of all output, if a writer has one."""
    writer = getattr(runner, "_writer", None)
    folder = getattr(runner, "checkpoints_path", None) if writer is None else getattr(writer, "log_path", None)
    return None if folder is None else str(folder)
