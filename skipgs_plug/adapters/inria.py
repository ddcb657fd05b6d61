"""Inria 3DGS (classic and current), and the base class of its forks.

The trainer is a function `training` in `train.py` that contains the loop. One iteration:
`update_learning_rate(iteration)`, `render(camera, ...)`, `loss.backward()`, densification, optimizer step. The gate
wraps these names, whichever module imported them.
"""

from __future__ import annotations

import functools
import inspect
import sys
import types
import weakref
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import torch

from skipgs_plug.adapters.base import gate_backwards_only
from skipgs_plug.adapters.half_size_cameras import HalfSizeCameras
from skipgs_plug.adapters.import_hook import when_imported
from skipgs_plug.adapters.loop_bounds import READS_GRADIENT, read_loops
from skipgs_plug.adapters.loop_code import LOOP, OPTIONS, LoopCode, asks_for_random_points, names_around, namespace_of
from skipgs_plug.adapters.marks import MarkedScript
from skipgs_plug.adapters.unknown_forks import (
    BY_HAND,
    CALLS,
    Unrecognised,
    begin_after,
    changing,
    refuse_loop_elsewhere,
    refuse_loop_without_end,
    unrecognised,
)
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.optimizers import held_by
from skipgs_plug.core.pace.parts import rate_of_positions
from skipgs_plug.core.source.functions import undecorated
from skipgs_plug.core.trainer_info import Densification, TrainerInfo
from skipgs_plug.core.views import view_key

RENDERER, MODEL = "gaussian_renderer", "scene.gaussian_model"  # modules of a checkout, which the script imports
UNTIL, FIRST = "densify_until_iter", 1  # option that ends densification, and number of the first iteration
RESETS = ("opacity_reset_interval",)  # option that the condition of opacity resets names
GROWS_WHOLE = "If steps accumulate gradients after densification, it runs whole."  # with `share`; see `Phased`


class InriaFamily(MarkedScript):
    """Base of Inria 3DGS and its forks: only the backward is gated, and optimizers keep their schedules.

    Attributes:
        renders: Names of the functions that render a training view. At least one must exist.
        structural: Methods of `GaussianModel` that make losses jump.
        scenes: Possible names of the loop's variable for its Scene.
        changes: Further methods that change the model. The gate begins after the last call of these and `structural`.
        pausing: Methods in `changes` that the trainer also calls after the gate has begun. Each call pauses the gate.
        calls: Further names of methods and noise that the adapter knows beyond those of Inria's loop.
        arguments: Arguments of the renderer that the adapter knows, beyond those of Inria's.
        densification: How to recognise its densification events; None if all iterations of densification must run.
        pure: Functions and methods that depend on the iteration, and need no iteration besides those of `always_run`.
        shows_half_size: Whether cameras may be shown at half their size; see `HalfSizeCameras`.
        known_names: Values of names that the loop assigns, if they are known before it. `begin` fills them.
    """

    renders: ClassVar[tuple[str, ...]] = ("render",)
    structural: ClassVar[tuple[str, ...]] = ("prune_points", "reset_opacity", "training_setup")
    scenes: ClassVar[tuple[str, ...]] = ("scene",)
    changes: ClassVar[tuple[str, ...]] = ("densify_and_prune",)
    pausing: ClassVar[tuple[str, ...]] = ()
    calls: ClassVar[tuple[str, ...]] = ()
    arguments: ClassVar[tuple[str, ...]] = ()
    pure: ClassVar[tuple[str, ...]] = ()
    shows_half_size: ClassVar[bool] = False
    # Statistics are means over visits, so some events may be left out if the others have enough visits.
    densification: ClassVar[Densification | None] = Densification(("densification_interval",), reset_marks=RESETS)

    def __init__(self, trainer: Any = None) -> None:
        super().__init__(trainer)
        self._step = 0
        self._model: Callable[[], Any] = lambda: None  # a new model means a new run
        self._label = "image_name"  # attribute of a camera that names its view
        self._code: LoopCode | None = None
        self._model_class: type = object
        self.known_names: dict[str, Any] = {}
        self._unknown = Unrecognised(*5 * (frozenset(),))
        self._densifies = True  # False if options keep the loop from densification, as LangSplat's
        self._cameras: HalfSizeCameras | None = None  # None if they cannot be shown at half their size

    def examine(self, code: LoopCode, renderers: Sequence[Callable[..., Any]], model: type) -> None:
        """Look for parts that this adapter does not know, before training begins: refuse them, or name them.

        Args:
            code: The training script.
            renderers: Its renderers that the adapter uses.
            model: Its GaussianModel.

        Raises:
            AdapterMismatchError: It cannot be gated.
        """
        self._code, self._model_class = code, model
        self._unknown = unrecognised(code, renderers, model, self._known_calls(), self.arguments)
        if code.syntax is None:
            self._unknown.refuse(self.difference(code), None)
        self._unknown.tell(self.difference(code), self.renders[0])

    def difference(self, code: LoopCode) -> str:
        """Return the beginning of a sentence about a script that does more than this adapter knows."""
        return f"{code.source} does more than {self.checked.partition(' (')[0]}, which adapter {self.name!r} is for"

    def begin(self, opt: Any, loop: Mapping[str, Any]) -> None:
        """Keep facts about the run that begins now, for later answers. Arguments as for `start_iter`.

        It is also called before the loop's conditions are read. Then `loop` has no iteration yet.
        """

    def start_iter(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """Return the first iteration that may be skipped, by default the first one that does not densify.

        Args:
            opt: The run's optimization options.
            loop: All names of `training` when its first iteration begins. Do not keep it.
        """
        return int(getattr(opt, UNTIL)) if self._densifies else FIRST

    def settled_iter(self, opt: Any, loop: Mapping[str, Any]) -> int | None:
        """Return the first iteration after the last known prune; None without one. Arguments as for `start_iter`."""
        return None

    def gradients_read_until(self, opt: Any, loop: Mapping[str, Any]) -> int:
        """Return the first iteration whose gradients only the optimizers read. Arguments as for `start_iter`."""
        return InriaFamily.start_iter(self, opt, loop)  # not that of a fork which begins later

    def steps_each(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        """Whether optimizers would accumulate, but step in each iteration that runs; see `TrainerInfo.steps_each`."""
        return False

    def accumulates(self, opt: Any, loop: Mapping[str, Any]) -> bool:
        """Whether optimizers step at certain iterations, with gathered gradients. Arguments as for `start_iter`."""
        return False

    def random_points(self, opt: Any, loop: Mapping[str, Any]) -> bool | None:
        """Whether the scene begins with random points; see `TrainerInfo`. Arguments as for `start_iter`."""
        return asks_for_random_points(loop)

    def attach(self, hooks: Hooks) -> None:
        names = namespace_of(self.trainer)
        if names is None or LOOP not in names or "GaussianModel" not in names:
            raise self.mismatch(f"a train module with {LOOP}() and GaussianModel, or its {LOOP} function")
        code = LoopCode.of_module(names)
        self.require_own(code)
        refuse_loop_elsewhere(code, self.difference(code))
        self.examine(code, self._renderers(names), names["GaussianModel"])
        self._attach_to_renderer(hooks, names)
        self._attach_to_model(hooks, names)
        self._attach_to_loop(hooks, names, code)

    def attach_script(self, hooks: Hooks) -> None:
        code = LoopCode.of_script(self.script or Path(sys.argv[0]))
        if not code.used:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} expects a function {LOOP}(), which {code.source} does not have; name the "
                "script that has it, run this one with --no-gate if it does not train, or give SkipGate the module of "
                f"the function (docs/gate.md). It was checked with {self.checked}."
            )
        self.require_own(code)
        refuse_loop_elsewhere(code, self.difference(code))
        # The script binds names of these modules when it imports them, so they are replaced right before.
        loaded: dict[str, dict[str, Any]] = {}

        def examined(module: types.ModuleType, attach: Callable[[Hooks, dict[str, Any]], None]) -> None:
            with hooks.guarded():
                loaded[module.__name__] = vars(module)
                if len(loaded) == 2:
                    self.examine(code, self._renderers(loaded[RENDERER]), loaded[MODEL]["GaussianModel"])
                attach(hooks, vars(module))

        when_imported(hooks, MODEL, lambda module: examined(module, self._attach_to_model))
        when_imported(hooks, RENDERER, lambda module: examined(module, self._attach_to_renderer))
        self._attach_to_loop(hooks, hooks.script_globals, code)

    def _renderers(self, names: Mapping[str, Any]) -> list[Callable[..., Any]]:
        """Return the renderers of a namespace that the adapter uses.

        Raises:
            AdapterMismatchError: The namespace has no such renderer.
        """
        present = [names[name] for name in self.renders if name in names]
        if not present:
            raise AdapterMismatchError(
                f"Adapter {self.name!r} found none of {', '.join(self.renders)} in {names.get('__name__')}; "
                f"it was checked with {self.checked}. Name another adapter, such as inria."
            )
        return present

    def _attach_to_renderer(self, hooks: Hooks, names: dict[str, Any]) -> None:
        """Learn the training view from calls of the renderers."""

        def rendered(first: str, original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            camera = args[0] if args else kwargs.get(first)
            # A camera without a name is the viewer's, which renders before the training view.
            key = self.view_key(camera) if self.is_training_render(args[1:], kwargs) else None
            if key is not None:
                hooks.view(key)
            if self._cameras is not None:
                self._cameras.rendered(camera, training=key is not None)
            return original(*args, **kwargs)

        self._renderers(names)
        for name in self.renders:
            if name in names:
                first = next(iter(inspect.signature(names[name]).parameters), "")
                hooks.wrap(names, name, functools.partial(rendered, first))

    def _attach_to_model(self, hooks: Hooks, names: dict[str, Any]) -> None:
        """Learn iterations and structural changes from calls of the model's methods."""
        model = names["GaussianModel"]

        def rate_updated(original: Callable[..., Any], *args: Any, **kwargs: Any) -> Any:
            self._begins(hooks, args[0], sys._getframe(2))  # frame 2 is the caller's
            return original(*args, **kwargs)

        hooks.awaited.add("GaussianModel")  # a fork may import it and train a class of its own, as GES does
        hooks.before(model, "__init__", lambda *args, **kwargs: hooks.awaited.discard("GaussianModel"))
        hooks.wrap(model, "update_learning_rate", rate_updated)
        hooks.events(model, *(name for name in self.structural if hasattr(model, name)))

    def _begins(self, hooks: Hooks, model: Any, caller: types.FrameType) -> None:
        """An iteration begins in the loop around this frame. The first one reads the run."""
        with hooks.guarded():
            if self._cameras is not None:
                self._cameras.restore()
            # Variables of the loop are read once, before they hold the graph of an iteration.
            if self._model() is not model:
                self.require_own(LoopCode.of_module(caller.f_globals), begun=True)
                self._model = weakref.ref(model)
                self._read_run(hooks, names_around(caller))
                hooks.check_drift(lambda: held_by(self._model()))
            else:
                self._step = hooks.number(self._step + 1)
            hooks.iteration(self._step)

    def _attach_to_loop(self, hooks: Hooks, script: dict[str, Any], code: LoopCode) -> None:
        """Attach to the loop's backward and to its range."""
        if not code.counts_with_range:
            gate_backwards_only(hooks, self)
        hooks.gate_tensor_backward(*code.callers)
        hooks.loop(
            script,
            *{LOOP, *code.callers},
            always=self.always_run,
            pure=self.pure,
            densification=self.densification,
            known=self._known,
        )

    def _known(self, names: Mapping[str, Any]) -> Mapping[str, Any]:
        """Read the run before its conditions: the loop of a resumed run needs them before its first iteration."""
        if OPTIONS in names:
            self.begin(names[OPTIONS], names)
        return self.known_names

    def always_run(self, numbers: range) -> Iterable[int]:
        """Return iterations that must run for reasons that the loop's own conditions do not show."""
        return ()

    def is_training_render(self, args: tuple[Any, ...], kwargs: dict[str, Any]) -> bool:
        """Whether a render with these arguments after the camera can be the training render."""
        return torch.is_grad_enabled()

    def view_key(self, camera: Any) -> Any:
        """Return the key of this camera's view; None for a camera outside the training set."""
        return getattr(camera, self._label, None)

    def view_keys(self, cameras: Sequence[Any]) -> list[Any]:
        """Return every key that `view_key` can return."""
        return [getattr(camera, self._label) for camera in cameras]

    def _read_run(self, hooks: Hooks, loop: Mapping[str, Any]) -> None:
        """Read options, views and first iteration from the loop's variables."""
        scene = next((loop[name] for name in self.scenes if name in loop), None)
        number = "iteration" if self._code is None else self._code.number
        missing = [name for name in (OPTIONS, number) if name not in loop]
        if scene is None or missing:
            wanted = ", ".join(missing or self.scenes)
            raise self.mismatch(f"{wanted} among the variables of {LOOP}(); rename the script's own to that")
        opt, self._step, cameras = loop[OPTIONS], int(loop[number]), scene.getTrainCameras()
        if self.output_folder is None:  # a second run is not gated, and the report tells of the first
            self.output_folder = getattr(scene, "model_path", None)
        if not all(hasattr(camera, self._label) for camera in cameras):
            raise self.mismatch(f"cameras with an attribute {self._label}, by which it tells views apart; add one")
        if len({camera.image_name for camera in cameras}) < len(cameras):
            caution(
                "Several training images have the same name; the gate tells views apart by their position, "
                "which stays the same in a resumed run only with the same seed."
            )
            self._label = "uid"
        self.begin(opt, loop)
        ends = self._ends_of_calls(loop)
        start, read_until = self.start_iter(opt, loop), self.gradients_read_until(opt, loop)
        known = None if self._unknown.listed or not self.shows_half_size else self._code
        self._cameras = HalfSizeCameras.of(hooks, cameras, known, self.renders)
        hooks.ready(
            TrainerInfo(
                begin_after(start, opt.iterations, ends),
                settled_iter=self.settled_iter(opt, loop),
                view_names=[view_key(key) for key in self.view_keys(cameras)],
                max_steps=opt.iterations,
                gradients_read_until=max(read_until, ends.get(READS_GRADIENT, 0)),
                accumulates=self.accumulates(opt, loop),
                steps_each=self.steps_each(opt, loop),
                slow_positions=True,  # they reach their last rate in `position_lr_max_steps`, by default 30,000
                positions_rate=rate_of_positions(held_by(self._model())),
                random_points=self.random_points(opt, loop),
                photographs=None if self._cameras is None else self._cameras.photographs,
            )
        )

    def _ends_of_calls(self, loop: Mapping[str, Any]) -> dict[str, int]:
        """Return the first iterations after calls that change the model, and learn whether the loop densifies."""
        if self._code is None or self._code.syntax is None:
            return {}
        parts = (self._model_class, undecorated(loop.get(LOOP)))
        awaited = self._unknown.calls.union(self.structural, self.changes, [READS_GRADIENT])
        stops = awaited | self._known_calls()
        found = read_loops(self._code.syntax, self._code.number, loop, parts, stops, self._code.callers)
        adds = changing(self._unknown.calls).union(self.changes) & found.ends.keys()
        self._densifies = UNTIL in found.asked or UNTIL not in found.passed_over or bool(adds)
        opt, who = loop[OPTIONS], self.difference(self._code)
        self._unknown.refuse(who, found)
        refuse_loop_without_end(found.ends, self.start_iter(opt, loop), opt.iterations, who)
        return {name: end for name, end in found.ends.items() if end is not None and name in awaited - {*self.pausing}}

    def _known_calls(self) -> frozenset[str]:
        """Return the names of calls that the adapter knows."""
        return CALLS.union(self.calls, self.structural, self.changes, self.pausing)


class Inria(InriaFamily):
    """graphdeco-inria/gaussian-splatting: densification ends before `densify_until_iter`.

    It is tried last, so it also takes unknown forks. What it does not know in them is refused, or warned of.
    """

    name = "inria"
    checked = "graphdeco-inria/gaussian-splatting 8a70a8cd and 54c035f (their scripts run)"
    project = "[Inria 3DGS](https://github.com/graphdeco-inria/gaussian-splatting)"
    gated = "From `densify_until_iter` on, or from the beginning if options keep the loop from densification."
    left_alone = (
        "The optimizers of Gaussians (sparse Adam too) and exposure have no gradients in skipped iterations. "
        "If two images have the same name in different folders (older versions keep the name only), the gate warns and "
        "tells views apart by their position. A fork that no adapter knows is refused if its loop changes tensors in "
        "place, and `share` if the loop counts without `range`."
    )
    stand_ins = "inria"
    shows_half_size = True

    @classmethod
    def recognises(cls, names: Container[str]) -> bool:
        return True  # tried last: a script of no known fork is the original's

    def difference(self, code: LoopCode) -> str:
        return f"{code.source} is a fork of Inria 3DGS that no adapter knows"

    def examine(self, code: LoopCode, renderers: Sequence[Callable[..., Any]], model: type) -> None:
        if UNTIL not in code.used:
            raise AdapterMismatchError(f"{self.difference(code)}: its loop never asks for {UNTIL}. {BY_HAND}")
        super().examine(code, renderers, model)

    @classmethod
    def stand_ins_for(cls, command: Sequence[str]) -> str:
        # Its train.py takes the presence of SparseGaussianAdam for the accelerated branch of the rasterizer.
        return "inria_accelerated" if "sparse_adam" in command else cls.stand_ins
