"""LiteGS: `litegs.training.start`, which trains in epochs and densifies after them."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from typing import Any

import torch

from skipgs_plug.adapters.base import AbstractAdapter, gate_backwards_only
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_bounds import ASSIGNED
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.adapters.unknown_forks import Survey
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo

MODULE, LOOP = "litegs.training.trainer", "start"
EXPECTED = (LOOP, "densify", "render", "StatisticsHelperInst")
CONTROLLER = "DensityControllerTamingGS"
EVENTS = ("split_and_clone", "prune", "reset_opacity")
# Further methods that a controller runs. Reordering Gaussians assigns to the data of parameters, and changes no image.
KNOWN = ("is_densify_actived", "_get_params_from_optimizer", ASSIGNED)
INDEX = 11  # position of the view's index (a tensor) among the arguments of `render_preprocess`


class LiteGS(AbstractAdapter):
    """An iteration begins with `render.render_preprocess`, which takes the view's index.

    Iterations are counted from 0 through all epochs. Both of its optimizers ignore parameters without a gradient.
    """

    name = "litegs"
    checked = "MooreThreads/LiteGS 004b952 (its loop read, and a look-alike: its rasterizer has no stand-in)"
    project = "[LiteGS](https://github.com/MooreThreads/LiteGS)"
    gated = "From epoch `densify_until` on, after a pause for the opacity reset that usually ends the epoch before."
    with_share = "Refused: whole iterations cannot be left out."
    left_alone = (
        "It reorders Gaussians now and then, which changes no image. Its loops run over epochs and a DataLoader. Needs "
        "CUDA: `--cpu` has no stand-in for its rasterizer."
    )

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._step: int | None = None
        self._names: list[str] = []
        self._loop: Callable[..., Any]

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        names = _namespace(trainer)
        return names is not None and all(name in names for name in EXPECTED)

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return code.leaves_training_to("litegs")

    def attach_script(self, hooks: Hooks) -> None:
        hooks.gate_tensor_backward(LOOP)
        when_imported(hooks, MODULE, lambda module: self._attach_to(hooks, vars(module)))
        gate_backwards_only(hooks, self)

    def attach(self, hooks: Hooks) -> None:
        names = _namespace(self.trainer)
        if names is None or not all(name in names for name in EXPECTED):
            raise self.mismatch(f"the module {MODULE} or its function {LOOP}")
        gate_backwards_only(hooks, self)
        self._attach_to(hooks, names)

    def _attach_to(self, hooks: Hooks, names: dict[str, Any]) -> None:
        def preprocessed(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            frame = sys._getframe(2)
            if torch.is_grad_enabled() and frame.f_code.co_name == LOOP:
                with hooks.guarded():
                    self._begins(hooks, frame, args)
            return original(*args, **kwargs)

        self._loop = names[LOOP]
        hooks.wrap(names["render"], "render_preprocess", preprocessed)
        controller = getattr(names["densify"], CONTROLLER)
        hooks.events(controller, *(name for name in EVENTS if hasattr(controller, name)))
        hooks.gate_tensor_backward(LOOP)

    def _begins(self, hooks: Hooks, frame: types.FrameType, args: tuple[Any, ...]) -> None:
        if self._step is None:
            self._step = self._read_run(hooks, frame.f_locals)
        else:
            self._step += 1
        index = args[INDEX]
        hooks.iteration(self._step)
        hooks.view(lambda: self._names[int(index)])

    def _read_run(self, hooks: Hooks, loop: dict[str, Any]) -> int:
        """Read the run from the loop's variables, and return the number of its first iteration."""
        views = len(loop["train_loader"])
        self._names = [str(frame.name) for frame in loop["trainingset"].frames]
        self.output_folder = loop["lp"].model_path
        end, last = int(loop["dp"].densify_until) * views, int(loop["total_epoch"]) * views - 1
        survey = Survey(self, [type(loop["density_controller"])], KNOWN, EVENTS, [LOOP], through=["step"])
        survey.read(self._loop, "epoch", values=loop)
        hooks.ready(
            TrainerInfo(
                survey.start_after_changes(end, last, unit=views),
                view_names=self._names,
                max_steps=last,
                gradients_read_until=max(end, survey.end_of_gradients(end, last, views)),
            )
        )
        return int(loop["epoch"]) * views


def _namespace(trainer: Any) -> dict[str, Any] | None:
    if isinstance(trainer, types.ModuleType):
        return vars(trainer)
    return trainer.__globals__ if isinstance(trainer, types.FunctionType) and trainer.__name__ == LOOP else None
