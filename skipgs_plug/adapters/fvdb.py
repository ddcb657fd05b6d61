"""fVDB Reality Capture: `SceneOptimizationRunner`, whose loop takes minibatches of a DataLoader."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import torch

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo

MODULE, LOOP = "fvdb_reality_capture.training.scene_optimization_runner", "train"
EXPECTED = (LOOP, "config", "training_dataset", "optimizer", "_global_step", "_start_step")
BATCH = "batch"  # one key for the joint loss of random batches
EVENTS = ("refine_gaussians", "reset_opacities", "remove_gaussians")
KNOWN = ("step", "zero_grad", "state_dict")  # further methods of the optimizer that the loop runs


class FVDB(AbstractAdapter):
    """An iteration begins when the loop takes a minibatch of its training set, at step `_global_step` (counted from 0).

    Its optimizer steps one torch optimizer per parameter, which does nothing without a gradient.
    """

    name = "fvdb"
    checked = "openvdb/fvdb-reality-capture 0761837 (its loop read, and a look-alike; not the later command frgs)"
    project = "[fVDB Reality Capture](https://github.com/openvdb/fvdb-reality-capture)"
    gated = (
        "From epoch `refine_stop_epoch` on, or from `pose_opt_stop_epoch` on if it is later and camera poses are "
        "optimized. Opacities are reset every `reset_opacities_every_epoch` until the end; each reset pauses the gate."
    )
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = (
        "Batches of several images have one joint loss and so one mean. Several crops per image are refused, since "
        "each has a backward. Its loops run over epochs and a DataLoader. Needs CUDA."
    )

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        return all(hasattr(trainer, name) for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return "SceneOptimizationRunner" in code.names

    def attach_script(self, hooks: Hooks) -> None:
        gate_backwards_only(hooks, self)
        when_imported(hooks, MODULE, lambda module: self.attach_on_call(hooks, module.SceneOptimizationRunner, LOOP))

    def attach(self, hooks: Hooks) -> None:
        runner = self.trainer
        if not self.matches(runner):
            raise self.mismatch(f"a SceneOptimizationRunner with {', '.join(EXPECTED)}")
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
                if runner._global_step >= runner._start_step:  # a resumed run passes over the others
                    with hooks.guarded():
                        hooks.iteration(runner._global_step)
                        ids = minibatch["image_id"]
                        hooks.view(BATCH if batched else lambda ids=ids: int(ids[0]))
                yield minibatch

        hooks.wrap(torch.utils.data.DataLoader, "__iter__", iterated)
        optimizer = runner.optimizer
        hooks.events(optimizer, *(name for name in EVENTS if hasattr(optimizer, name)))
        hooks.gate_tensor_backward(LOOP)
        folder = getattr(runner, "checkpoints_path", None)
        self.output_folder = None if folder is None else str(folder)
        end = int(config.refine_stop_epoch * len(dataset))
        if config.optimize_camera_poses:
            end = max(end, int(config.pose_opt_stop_epoch * len(dataset)))
        survey = Survey(self, [type(optimizer)], KNOWN, EVENTS)
        survey.read(getattr(runner, LOOP), "self._global_step")
        start = survey.start_after_changes(end, math.inf if config.max_steps is None else config.max_steps)
        hooks.ready(TrainerInfo(start, max_steps=config.max_steps, gradients_read_until=end))
