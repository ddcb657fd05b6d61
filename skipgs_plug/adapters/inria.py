"""Inria 3DGS (classic and current), and the answers that its forks share.

The trainer is a function `training` in `train.py`, with the loop inline. One iteration:
`update_learning_rate(iteration)`, `render(camera, ...)`, `loss.backward()`, densification, optimizer step.
Everything the gate needs happens through names that can be wrapped, whoever imported them.
"""

from __future__ import annotations

import importlib
import sys
import types
import warnings
import weakref
from abc import abstractmethod
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

import torch

from skipgs_plug.adapters import registry
from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.facts import TrainerFacts
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.views import view_key

LOOP = "training"  # name of the function that holds the loop, in the whole family


class InriaFamily(AbstractAdapter):
    """Shared by Inria 3DGS and its forks: only the backward is gated, optimizers keep their schedules.

    Attributes:
        mark: a global name that only this fork's training scripts have.
        renders: names of the functions that render a training view; at least one must exist.
        structural: methods of `GaussianModel` that make losses jump.
        scenes: names that the loop's variable for its Scene can have.
    """

    mark: ClassVar[str] = ""
    renders: ClassVar[tuple[str, ...]] = ("render",)
    structural: ClassVar[tuple[str, ...]] = ("prune_points", "reset_opacity", "training_setup")
    scenes: ClassVar[tuple[str, ...]] = ("scene",)

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._step = 0
        self._model: Callable[[], Any] = lambda: None  # a new model means a new run
        self._label = "image_name"  # attribute of a camera that names its view

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        names = namespace_of(trainer)
        return names is not None and LOOP in names and "GaussianModel" in names and cls.recognises(names)

    @classmethod
    def recognises(cls, names: Mapping[str, Any]) -> bool:
        """Whether a train module with these global names is this trainer's, unless one asked before it knows it."""
        return cls.mark in names

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        """Keep what later answers need of a run, which begins now; arguments as for `start_iter`."""

    @abstractmethod
    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """First iteration that may be skipped.

        Args:
            opt: The run's optimization options.
            loop: Everything that `training` has a name for, when its first iteration begins. Not to be kept.
        """

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """First iteration whose gradients only the optimizers read; arguments as for `start_iter`."""
        return int(opt.densify_until_iter)

    def attach(self, hooks: Hooks) -> None:
        names = namespace_of(self.trainer)
        if names is None or LOOP not in names or "GaussianModel" not in names:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} expects a train module with {LOOP}() and GaussianModel, or its "
                f"{LOOP} function, as in {self.checked}."
            )
        self._refuse_fork(names)
        self._attach_to(hooks, names, names["GaussianModel"])

    def attach_script(self, hooks: Hooks) -> None:
        # The script binds these names when it imports them, so they are replaced before.
        renderer = importlib.import_module("gaussian_renderer")
        model = importlib.import_module("scene.gaussian_model").GaussianModel
        self._attach_to(hooks, vars(renderer), model)

    def _attach_to(self, hooks: Hooks, names: dict[str, Any], model: type) -> None:
        present = [name for name in self.renders if name in names]
        if not present:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} found none of {', '.join(self.renders)} in {names.get('__name__')}; "
                f"it was checked with {self.checked}."
            )

        def heartbeat(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            # Frame 2 is the loop. Its variables are read once, before they hold an iteration's graph.
            if self._model() is not args[0]:
                frame = sys._getframe(2)
                self._refuse_fork(frame.f_globals)
                self._read_run(hooks, ChainMap(frame.f_locals, frame.f_globals))
                self._model = weakref.ref(args[0])
            else:
                self._step += 1
            hooks.iteration(self._step)
            return original(*args, **kwargs)

        def rendered(original: Callable[..., Any], camera: Any, *args: Any, **kwargs: Any) -> Any:
            # Not a training camera without a name: the viewer's, which renders before the training view.
            if self.is_training_render(args, kwargs) and (key := self.view_key(camera)) is not None:
                hooks.view(key)
            return original(camera, *args, **kwargs)

        hooks.wrap(model, "update_learning_rate", heartbeat)
        for name in present:
            hooks.wrap(names, name, rendered)
        hooks.events(model, *(name for name in self.structural if hasattr(model, name)))
        hooks.gate_tensor_backward(LOOP)

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Whether a render with these arguments after the camera can be the training one."""
        return torch.is_grad_enabled()

    def view_key(self, camera: Any) -> Any:
        """What names this camera's view; None for a camera that is not of the training set."""
        return getattr(camera, self._label, None)

    def view_keys(self, cameras: Sequence[Any]) -> list[Any]:
        """Every key that `view_key` can give."""
        return [getattr(camera, self._label) for camera in cameras]

    def _refuse_fork(self, names: Mapping[str, Any]) -> None:
        own, family = type(self), [one for one in registry.builtin_adapters() if issubclass(one, InriaFamily)]
        asked = family if own in family else [own, *family]
        right = next(one for one in asked if one.recognises(names))  # the last one does in any case
        if right is not own:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} is for {self.checked}, but {names.get('__file__') or names.get('__name__')} "
                f"looks like the training script of {right.name!r}."
            )

    def _read_run(self, hooks: Hooks, loop: Mapping[str, Any]) -> None:
        """Read options, views and first iteration from the loop's variables."""
        scene = next((loop[name] for name in self.scenes if name in loop), None)
        missing = [name for name in ("opt", "iteration") if name not in loop]
        if scene is None or missing:
            wanted = ", ".join(missing or self.scenes)
            raise AdapterMismatchError(
                f"Adapter {self.name!r} expects {wanted} among the variables of {LOOP}(), as in {self.checked}."
            )
        opt, self._step = loop["opt"], int(loop["iteration"])
        self.output_folder = getattr(scene, "model_path", None)
        cameras = scene.getTrainCameras()
        names = [camera.image_name for camera in cameras]
        if len(set(names)) < len(names):
            warnings.warn(
                "Several training images have the same name; the gate tells views apart by their position, "
                "which stays the same in a resumed run only with the same seed.",
                RuntimeWarning,
                stacklevel=2,
            )
            self._label = "uid"
        self.begin(opt, loop)
        hooks.ready(
            TrainerFacts(
                self.start_iter(opt, loop),
                view_names=[view_key(key) for key in self.view_keys(cameras)],
                max_steps=opt.iterations,
                gradients_read_until=self.gradients_read_until(opt, loop),
            )
        )


class Inria(InriaFamily):
    """graphdeco-inria/gaussian-splatting: densification ends before `densify_until_iter`."""

    name = "inria"
    checked = "graphdeco-inria/gaussian-splatting 8a70a8cd and 54c035f (their scripts, run on the CPU)"

    @classmethod
    def recognises(cls, names: Mapping[str, Any]) -> bool:
        return True  # asked last: what is not a fork's is the original's

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        return int(opt.densify_until_iter)


def namespace_of(trainer: Any) -> dict[str, Any] | None:
    """Global names of a train module, or of the module that a training function is from."""
    if isinstance(trainer, types.ModuleType):
        return vars(trainer)
    if isinstance(trainer, types.FunctionType):
        return trainer.__globals__
    return None
