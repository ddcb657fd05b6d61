"""Inria 3DGS (classic and current), and the answers that its forks share.

The trainer is a function `training` in `train.py`, with the loop inline. One iteration:
`update_learning_rate(iteration)`, `render(camera, ...)`, `loss.backward()`, densification, optimizer step.
Everything the gate needs happens through names that can be wrapped, whoever imported them.
"""

from __future__ import annotations

import sys
import types
import weakref
from collections import ChainMap
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch

from skipgs_plug.adapters import registry
from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.drift_check import DriftCheck
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_bounds import last_calls
from skipgs_plug.adapters.loop_code import LOOP, LoopCode
from skipgs_plug.adapters.unknown_forks import BY_HAND, Unrecognised, begin_after, left_alone, unrecognised
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import Densification, TrainerInfo
from skipgs_plug.core.views import view_key

# Modules of a checkout, each loaded when the script asks for it.
RENDERER, MODEL = "gaussian_renderer", "scene.gaussian_model"


class InriaFamily(AbstractAdapter):
    """Shared by Inria 3DGS and its forks: only the backward is gated, optimizers keep their schedules.

    Attributes:
        mark: a name that only this fork's training scripts have, or only their loop uses.
        renders: names of the functions that render a training view; at least one must exist.
        structural: methods of `GaussianModel` that make losses jump.
        scenes: names that the loop's variable for its Scene can have.
        calls: what the loop does beyond Inria's, and the adapter knows: methods of the model, functions that draw
            noise, methods that change a tensor in place.
        arguments: arguments of the renderer that the adapter knows, beyond Inria's.
        densification: how its densification events are told; None if growth must run whole.
        known_names: values of names that the loop assigns, where they are known before it; filled by `begin`.
    """

    mark: ClassVar[str] = ""
    renders: ClassVar[tuple[str, ...]] = ("render",)
    structural: ClassVar[tuple[str, ...]] = ("prune_points", "reset_opacity", "training_setup")
    scenes: ClassVar[tuple[str, ...]] = ("scene",)
    calls: ClassVar[tuple[str, ...]] = ()
    arguments: ClassVar[tuple[str, ...]] = ()
    # Statistics are means over visits, so events with enough visits behind them may be fewer.
    densification: ClassVar[Densification | None] = Densification(marks=("densification_interval",))

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._step = 0
        self._model: Callable[[], Any] = lambda: None  # a new model means a new run
        self._label = "image_name"  # attribute of a camera that names its view
        self._code: LoopCode | None = None
        self._drift: DriftCheck
        self.known_names: dict[str, Any] = {}
        self._unknown = Unrecognised(*5 * (frozenset(),))

    @classmethod
    def matches(cls, trainer: Any) -> bool:
        names = namespace_of(trainer)
        return (
            names is not None
            and {LOOP, "GaussianModel"} <= names.keys()
            and cls.recognises_script(LoopCode.of_module(names))
        )

    @classmethod
    def recognises_script(cls, code: LoopCode) -> bool:
        return bool(code.used) and "GaussianModel" in code.names and cls.recognises(code.names)

    @classmethod
    def recognises(cls, names: Container[str]) -> bool:
        """Whether a training script with these names is this trainer's, unless one asked before it knows it.

        Args:
            names: Its global names, and whatever its function `training` uses, attributes too.
        """
        return cls.mark in names

    def examine(self, code: LoopCode, renderers: Sequence[Callable[..., Any]], model: type) -> None:
        """Look for what this adapter does not know, before anything is trained: refuse it, or say it.

        Args:
            code: The training script.
            renderers: Those of its renderers that the adapter asks for.
            model: Its GaussianModel.

        Raises:
            AdapterMismatchError: It cannot be gated.
        """
        calls = (*self.calls, *self.structural)
        self._code, self._unknown = code, unrecognised(code, renderers, model, calls, self.arguments)
        self._unknown.refuse(self.difference(code))
        if self._unknown.listed:
            caution(
                f"{self.difference(code)}. Recognised: {', '.join(self.renders[:1])}, backward, "
                f"{', '.join(sorted(self._unknown.known))}. {left_alone(self._unknown.listed)}"
            )

    def difference(self, code: LoopCode) -> str:
        """Beginning of a sentence about a script that does more than this adapter knows."""
        return f"{code.source} does more than {self.checked.partition(' (')[0]}, which adapter {self.name!r} is for"

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        """Keep what later answers need of a run, which begins now; arguments as for `start_iter`.

        Called once more before the loop's conditions are read, where `loop` has no iteration yet.
        """

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """First iteration that may be skipped: by default the first one that does not densify.

        Args:
            opt: The run's optimization options.
            loop: Everything that `training` has a name for, when its first iteration begins. Not to be kept.
        """
        return int(opt.densify_until_iter)

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """First iteration whose gradients only the optimizers read; arguments as for `start_iter`."""
        return int(opt.densify_until_iter)

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        """Whether optimizers step by the iteration's number, on gradients gathered since; as for `start_iter`."""
        return False

    def attach(self, hooks: Hooks) -> None:
        names = namespace_of(self.trainer)
        if names is None or LOOP not in names or "GaussianModel" not in names:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} expects a train module with {LOOP}() and GaussianModel, or its "
                f"{LOOP} function, as in {self.checked}."
            )
        code = LoopCode.of_module(names)
        self._refuse_fork(code)
        self.examine(code, self._renderers(names), names["GaussianModel"])
        self._attach_to_renderer(hooks, names)
        self._attach_to_model(hooks, names)
        self._attach_to_loop(hooks, names)

    def attach_script(self, hooks: Hooks) -> None:
        code = LoopCode.of_script(Path(sys.argv[0]))
        if not code.used:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} expects a function {LOOP}(), which {code.source} does not have; "
                f"it was checked with {self.checked}."
            )
        self._refuse_fork(code)
        # The script binds names of these modules when it imports them: they are replaced right before.
        loaded: dict[str, dict[str, Any]] = {}

        def examined(module: types.ModuleType, attach: Callable[[Hooks, dict[str, Any]], None]) -> None:
            with hooks.guarded():
                loaded[module.__name__] = vars(module)
                if len(loaded) == 2:
                    self.examine(code, self._renderers(loaded[RENDERER]), loaded[MODEL]["GaussianModel"])
                attach(hooks, vars(module))

        when_imported(hooks, MODEL, lambda module: examined(module, self._attach_to_model))
        when_imported(hooks, RENDERER, lambda module: examined(module, self._attach_to_renderer))
        self._attach_to_loop(hooks, hooks.script_globals)

    def _renderers(self, names: Mapping[str, Any]) -> list[Callable[..., Any]]:
        """Those renderers of a namespace that the adapter asks for.

        Raises:
            AdapterMismatchError: There are none.
        """
        present = [names[name] for name in self.renders if name in names]
        if not present:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} found none of {', '.join(self.renders)} in {names.get('__name__')}; "
                f"it was checked with {self.checked}."
            )
        return present

    def _attach_to_renderer(self, hooks: Hooks, names: dict[str, Any]) -> None:
        """Learn the training view from what is rendered."""

        def rendered(original: Callable[..., Any], camera: Any, *args: Any, **kwargs: Any) -> Any:
            # Not a training camera without a name: the viewer's, which renders before the training view.
            if self.is_training_render(args, kwargs) and (key := self.view_key(camera)) is not None:
                hooks.view(key)
            return original(camera, *args, **kwargs)

        self._renderers(names)
        for name in self.renders:
            if name in names:
                hooks.wrap(names, name, rendered)

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        """Learn iterations and structural changes from calls of the model's methods."""
        model = names["GaussianModel"]

        def rate_updated(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            self._begins(hooks, args[0], sys._getframe(2))  # frame 2 is the loop's
            return original(*args, **kwargs)

        hooks.wrap(model, "update_learning_rate", rate_updated)
        hooks.events(model, *(name for name in self.structural if hasattr(model, name)))

    def _begins(self, hooks: Hooks, model: Any, frame: types.FrameType) -> None:
        """An iteration begins in the loop that this frame is of; the first one reads the run."""
        with hooks.guarded():
            # Variables of the loop are read once, before they hold an iteration's graph.
            if self._model() is not model:
                self._refuse_fork(LoopCode.of_module(frame.f_globals))
                self._read_run(hooks, ChainMap(frame.f_locals, frame.f_globals))
                self._model = weakref.ref(model)
                self._drift = DriftCheck(hooks.state)
            else:
                self._step = hooks.number(self._step + 1)
                own = [one for one in vars(model).values() if isinstance(one, torch.optim.Optimizer)]
                if moved := self._drift.moved(own):
                    self._give_up(hooks, moved)
                    return
            hooks.iteration(self._step)

    def _attach_to_loop(self, hooks: Hooks, script: dict[str, Any]) -> None:
        """Hold on to the loop's backward and to its range."""
        hooks.gate_tensor_backward(LOOP)
        hooks.loop(script, LOOP, always=self.always_run, densification=self.densification, known=self._known)

    def _known(self, names: Mapping[str, Any]) -> Mapping[str, Any]:
        """Read the run before its conditions are read: the loop of a resumed one asks before its first iteration."""
        if "opt" in names:
            self.begin(names["opt"], names)
        return self.known_names

    def always_run(self, numbers: range) -> Iterable[int]:
        """Those of these iterations on whose number something hangs that the loop itself does not say."""
        return ()

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Whether a render with these arguments after the camera can be the training one."""
        return torch.is_grad_enabled()

    def view_key(self, camera: Any) -> Any:
        """What names this camera's view; None for a camera that is not of the training set."""
        return getattr(camera, self._label, None)

    def view_keys(self, cameras: Sequence[Any]) -> list[Any]:
        """Every key that `view_key` can give."""
        return [getattr(camera, self._label) for camera in cameras]

    def _refuse_fork(self, code: LoopCode) -> None:
        own, family = type(self), [one for one in registry.builtin_adapters() if issubclass(one, InriaFamily)]
        asked = family if own in family else [own, *family]
        right = next(one for one in asked if one.recognises(code.names))  # the last one does in any case
        if right is not own:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} is for {self.checked}, but {code.source} "
                f"looks like the training script of {right.name!r}."
            )

    def _give_up(self, hooks: Hooks, moved: list[str]) -> None:
        """Let training go on ungated: an error would throw away what was trained so far."""
        hooks.release(
            f"The loop moved {', '.join(moved)} in iteration {self._step - 1}, whose backward was skipped: it does "
            f"something of its own that adapter {self.name!r} does not know. The gate is detached, and training goes "
            "on without it. Gate this loop by hand with SkipGate(start_iter=...).",
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
            caution(
                "Several training images have the same name; the gate tells views apart by their position, "
                "which stays the same in a resumed run only with the same seed."
            )
            self._label = "uid"
        self.begin(opt, loop)
        hooks.ready(
            TrainerInfo(
                self._start_after_changes(opt, loop),
                view_names=[view_key(key) for key in self.view_keys(cameras)],
                max_steps=opt.iterations,
                gradients_read_until=self.gradients_read_until(opt, loop),
                accumulates=self.accumulates(opt, loop),
            )
        )

    def _start_after_changes(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """`start_iter`, or the end of whatever this adapter does not know, where it ends later than that."""
        start = self.start_iter(opt, loop)
        if self._code is None or self._code.syntax is None:
            return start
        return begin_after(start, opt.iterations, last_calls(self._code.syntax, self.may_end_later(), loop))

    def may_end_later(self) -> frozenset[str]:
        """Methods of the model that the gate does not begin before the loop has called for the last time."""
        return self._unknown.calls


class Inria(InriaFamily):
    """graphdeco-inria/gaussian-splatting: densification ends before `densify_until_iter`.

    Asked last, it is also what an unknown fork is taken for: one whose loop draws noise or writes into tensors is
    refused, and one that calls more of its model or its renderer than Inria's is gated with a warning.
    """

    name = "inria"
    checked = "graphdeco-inria/gaussian-splatting 8a70a8cd and 54c035f (their scripts, run on the CPU)"
    project = "[Inria 3DGS](https://github.com/graphdeco-inria/gaussian-splatting)"
    gated = "From `densify_until_iter` on: that iteration does not densify any more."
    left_alone = (
        "Both optimizers of the current version, sparse Adam too. Renders of the viewer and of evaluations are not "
        "taken for training. When two images have the same name in different folders (older versions keep the name "
        "only), the gate warns and tells views apart by their position. A fork that no adapter knows is refused when "
        "its loop changes tensors in place. Otherwise the gate lists what it did not recognise, and begins after the "
        "last iteration that the loop's conditions give for it."
    )
    stand_ins = "inria"

    @classmethod
    def recognises(cls, names: Container[str]) -> bool:
        return True  # asked last: what is not a fork's is the original's

    def difference(self, code: LoopCode) -> str:
        return f"{code.source} is a fork of Inria 3DGS that no adapter knows"

    def examine(self, code: LoopCode, renderers: Sequence[Callable[..., Any]], model: type) -> None:
        if "densify_until_iter" not in code.used:
            raise AdapterMismatchError(
                f"{self.difference(code)}: its loop never asks for densify_until_iter. {BY_HAND}"
            )
        super().examine(code, renderers, model)

    def may_end_later(self) -> frozenset[str]:
        return super().may_end_later() | {"densify_and_prune", "prune_points", "reset_opacity"}

    @classmethod
    def stand_ins_for(cls, command: Sequence[str]) -> str:
        # Its train.py takes the presence of SparseGaussianAdam for the accelerated branch of the rasterizer.
        return "inria_accelerated" if "sparse_adam" in command else cls.stand_ins


def namespace_of(trainer: Any) -> dict[str, Any] | None:
    """Global names of a train module, or of the module that a training function is from."""
    if isinstance(trainer, types.ModuleType):
        return vars(trainer)
    if isinstance(trainer, types.FunctionType):
        return trainer.__globals__
    return None
