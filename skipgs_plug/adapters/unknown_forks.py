"""Find the calls of a trainer that its adapter does not know, name them, and start the gate after they end."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

import torch

from skipgs_plug.adapters.loop_bounds import ASSIGNED, READS_GRADIENT, SETS_END, CallReader
from skipgs_plug.adapters.loop_code import LOOP, OPTIONS, LoopCode
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.hooks import Adapter
from skipgs_plug.core.source.functions import undecorated

# Functions that draw random numbers.
NOISE = frozenset({"randn", "randn_like", "normal"})
# Methods of a tensor whose names end in "_" but that change no values, or none that they have changed already: in a
# skipped iteration nothing moves a value that was clamped.
HARMLESS = frozenset({"requires_grad_", "share_memory_", "detach_", "rename_", "clamp_", "clamp_min_", "clamp_max_"})
# Methods of the model that Inria's loops (classic and current) call, and `compute_3D_filter` of Mip-Splatting, which
# many forks call until the end. It depends on positions and cameras only, so it changes only if the model moves.
CALLS = frozenset(
    {
        "add_densification_stats",
        "capture",
        "compute_3D_filter",
        "densify_and_prune",
        "get_opacity",
        "get_rotation",
        "get_scaling",
        "get_xyz",
        "oneupSHdegree",
        "restore",
        "save_ply",
        "training_setup",
        "update_learning_rate",
    }
)
# Arguments that these loops pass to `render`.
ARGUMENTS = frozenset(
    {
        "viewpoint_camera",
        "pc",
        "pipe",
        "bg_color",
        "scaling_modifier",
        "override_color",
        "separate_sh",
        "use_trained_exp",
    }
)
BY_HAND = "Gate it by hand with SkipGate(start_iter=...), or write an adapter (CONTRIBUTING.md)."


class Unrecognised(NamedTuple):
    """Parts of a loop of the Inria family that its adapter does not know.

    Attributes:
        calls: Methods of the model.
        arguments: Arguments of the renderer.
        noise: Functions that draw random numbers.
        writes: Methods that change a tensor in place, and "data" if the loop assigns to an attribute of that name.
        known: Names that the adapter recognised.
    """

    calls: frozenset[str]
    arguments: frozenset[str]
    noise: frozenset[str]
    writes: frozenset[str]
    known: frozenset[str]

    def refuse(self, who: str, found: CallReader | None) -> None:
        """Raise an error if the loop itself changes tensors. Noise alone is accepted: it may be the input of a network.

        Args:
            who: Start of the message.
            found: What was found in the loop; None if it has no source. Then any such method in it counts.

        Raises:
            AdapterMismatchError: The loop changes tensors in place, and no option keeps it from that.
        """
        writes = {name for name in self.writes if found is None or found.reaches(name)}
        if writes:
            names = ", ".join(sorted(writes | self.noise))
            raise AdapterMismatchError(
                f"{who}: its loop itself changes values ({names}), and would still do so in skipped iterations. "
                f"{BY_HAND}"
            )

    def tell(self, who: str, render: str) -> None:
        """Warn about the unrecognised parts, if there are any.

        Args:
            who: Start of the message.
            render: Name of the renderer.
        """
        if self.listed:
            caution(
                f"{who}. Recognised: {render}, backward, {', '.join(sorted(self.known))}. {left_alone(self.listed)}"
            )

    @property
    def listed(self) -> list[str]:
        """The unrecognised parts, as messages show them."""
        return [
            *(f"render({name}=)" for name in sorted(self.arguments)),
            *(spelled(name) for name in sorted(self.calls | self.noise)),
        ]


def unrecognised(
    code: LoopCode,
    renderers: Iterable[Callable[..., object]],
    model: type,
    known: frozenset[str],
    arguments: Iterable[str],
) -> Unrecognised:
    """Compare a loop and the functions that it calls with the names that its adapter knows.

    Args:
        code: The training script.
        renderers: Renderers of the script.
        model: GaussianModel of the script.
        known: Names that the adapter knows: methods of the model, functions that draw noise, and methods that change
            tensors in place.
        arguments: Arguments of the renderers that the adapter knows in addition to those of Inria's loop.
    """
    parameters = {name for one in renderers for name in inspect.signature(one).parameters}
    writes = {name for name in code.repeated if writes_in_place(name)} | ({"data"} & code.stored)
    return Unrecognised(
        frozenset(code.repeated & _methods(model) - known),
        frozenset(code.keywords & parameters - ARGUMENTS - set(arguments)),
        frozenset(code.called & NOISE - known),  # `camera.normal` is the name of no noise
        frozenset(writes - known),
        code.used & known,
    )


def refuse_loop_elsewhere(code: LoopCode, who: str) -> None:
    """Raise an error if `training` is not the loop of the Inria family, before the script imports anything.

    Args:
        code: The training script.
        who: Start of the message.

    Raises:
        AdapterMismatchError: `training` calls no backward (in 4DGaussians, another function has the loop), or has no
            variable with the options (in Self-Organizing Gaussians, they are parts of one `cfg`).
    """
    if not code.callers:
        callers = ", ".join(f"{name}()" for name in sorted(code.backward & code.used))
        calls = f"{callers} calls backward in its place" if callers else "nor does another function in this file"
        raise AdapterMismatchError(
            f"{who}: {LOOP}() does not call loss.backward(), {calls}, and such a loop is not supported. {BY_HAND}"
        )
    if OPTIONS not in code.variables | code.names:
        raise AdapterMismatchError(
            f"{who}: {LOOP}() has no variable {OPTIONS!r}, whose densify_until_iter and iterations the gate needs. "
            f"{BY_HAND}"
        )


def refuse_loop_without_end(ends: Mapping[str, int | None], start: float, last: float, who: str) -> None:
    """Raise an error if a loop reads gradients until its end, or sets the end of densification itself.

    Args:
        ends: See `CallReader`.
        start: First iteration after densification, according to the options. A run may end before it.
        last: Last iteration of the run.
        who: Start of the message.

    Raises:
        AdapterMismatchError: It does. GES logs norms of gradients, also in the last iteration, before it saves.
            Binocular3DGS puts the end off when its opacities begin to decay.
    """
    if SETS_END in ends:
        raise AdapterMismatchError(
            f"{who}: its loop itself sets densify_until_iter or refine_stop_iter, so it is not known when "
            f"densification ends. {BY_HAND}"
        )
    until = ends.get(READS_GRADIENT, 0)
    if until is None or (until > start and until >= last):
        raise AdapterMismatchError(
            f"{who}: its loop reads gradients (grad) until its end, for example to log them or to densify, and a "
            "skipped iteration has none. Switch that off if the script has an option for it, such as one for the log. "
            f"{BY_HAND}"
        )


class Survey:
    """Finds calls of a fork that its parent's adapter does not know, and delays the start of the gate until they end.

    A fork may add a method to the model, or call a known method for longer than its parent. All its other names are
    those of its parent, so the parent's adapter accepts it.

    Args:
        adapter: The adapter, which messages name.
        owners: Classes and modules whose functions change the model.
        known: Functions of the owners that the adapter's trainer calls.
        changes: Functions of the owners that the adapter's trainer calls to change the model until densification ends.
        gated: See `CallReader`.
        through: Functions of the owners that call such changes in some iterations. Of all other functions of the
            owners, only the reads of gradients count.
        windows: See `CallReader`.
    """

    def __init__(
        self,
        adapter: Adapter,
        owners: Iterable[Any],
        known: Iterable[str],
        changes: Iterable[str],
        gated: Iterable[str],
        through: Iterable[str] = (),
        windows: Collection[str] = (),
    ) -> None:
        self._adapter = adapter
        self._changes = frozenset(changes)
        self._known = self._changes.union(known, through)
        owners = list(owners)
        self._methods = {ASSIGNED}.union(*map(_callables, owners))
        self._reader = CallReader(self._methods.difference(through), gated, windows)
        for owner in owners:
            self._reader.trainer.add(owner)

    def read(
        self, function: Any, *numbers: str, values: Mapping[str, Any] | None = None, end: int | None = None
    ) -> None:
        """Read a function or bound method of the trainer, and the trainer's functions that it calls.

        Args:
            function: The function.
            *numbers: Expressions that hold the iteration's number inside the function, as spelled by `ast.unparse`.
            values: Known values of its names.
            end: First iteration in which the trainer no longer calls the function; None if it calls it until the end.
        """
        plain, owner = undecorated(function), getattr(function, "__self__", None)
        if plain is not None:
            self._reader.trainer.add(plain)
            if owner is not None:
                self._reader.trainer.add(type(owner))
            self._reader.note(plain.__name__, end)
            self._reader.read(function, numbers, values or {}, end)

    @property
    def unknown(self) -> list[str]:
        """The calls that the adapter does not know, except getters."""
        called = self._reader.ends.keys() & self._methods - self._known
        return sorted(changing(called))

    def end_of_gradients(self, start: int, last: float = math.inf, unit: int = 1) -> int:
        """Return the first iteration from which on the trainer reads no gradients; 0 if it never reads any.

        Args:
            start: First iteration after densification, according to the trainer's options; 0 if they do not tell it.
            last: Last iteration of the run; infinite if unknown.
            unit: See `start_after_changes`.

        Raises:
            AdapterMismatchError: It reads them until the end of the run, or moves the end of its densification.
        """
        ends = self._ends(unit)
        refuse_loop_without_end(ends, start, last, f"Adapter {self._adapter.name!r} cannot gate this trainer")
        return ends.get(READS_GRADIENT) or 0

    def start_after_changes(self, start: int, last: float = math.inf, unit: int = 1) -> int:
        """Return the later of `start` and the end of the last change of the model, known or unknown.

        Warns about unrecognised calls, and about a later start of the gate.

        Args:
            start: First iteration after densification, according to the trainer's options.
            last: Last iteration of the run; infinite if unknown.
            unit: Number of iterations per step of the numbers in the source, for example the views of an epoch.
        """
        if self.unknown:
            name, checked = self._adapter.name, self._adapter.checked.partition(" (")[0]
            recognised = sorted(self._reader.ends.keys() & self._known) or ["no call of the model"]
            caution(
                f"The trainer does more than {checked}, for which adapter {name!r} was written. Recognised: "
                f"{', '.join(recognised)}. {left_alone(map(spelled, self.unknown))}"
            )
        names = self._changes.union(self.unknown, [READS_GRADIENT])
        ends = {name: end for name, end in self._ends(unit).items() if end is not None and name in names}
        return begin_after(start, last, ends)

    def _ends(self, unit: int) -> dict[str, int | None]:
        return {name: None if end is None else end * unit for name, end in self._reader.ends.items()}


def changing(names: Iterable[str]) -> set[str]:
    """Return the names of functions that may change the model: all but those of getters."""
    return {name for name in names if not name.startswith("get_")}


def left_alone(names: Iterable[str]) -> str:
    """Return a sentence about calls that were not recognised."""
    return f"Not recognised, and still executed in skipped iterations: {', '.join(names)}."


def spelled(name: str) -> str:
    """Return the name of a call as messages show it."""
    return {ASSIGNED: "an assignment to data", READS_GRADIENT: "for the grad of a tensor"}.get(name, f"{name}()")


def begin_after(start: int, last: float, ends: Mapping[str, int]) -> int:
    """Return the latest of `start` and the ends up to `last`; warn if it is later than `start`.

    Args:
        start: First iteration that the adapter allows the gate to skip.
        last: Last iteration of the run. The gate does not wait for calls that go on until it.
        ends: By the name of each call, the first iteration in which the loop no longer makes the call.
    """
    late = {name: end for name, end in ends.items() if start < end < last}
    if late:
        listed = ", ".join(f"{spelled(name)} until iteration {end - 1}" for name, end in sorted(late.items()))
        caution(f"The gate starts at iteration {max(late.values())} instead of {start}: the loop calls {listed}.")
    return max([start, *late.values()])


def _callables(owner: Any) -> set[str]:
    """Return the names of the methods of a class, or of the functions of a module."""
    inherited = set(dir(torch.nn.Module)) if inspect.isclass(owner) else set()
    names = {name for name in dir(owner) if not name.startswith("__")} - inherited
    functions = {name: undecorated(inspect.getattr_static(owner, name, None)) for name in names}
    own = owner.__name__ if inspect.ismodule(owner) else None  # a module also holds functions that it imported
    return {name for name, one in functions.items() if one is not None and own in (None, one.__module__)}


def writes_in_place(name: str) -> bool:
    """Return whether a tensor method of this name changes the values of the tensor in place, each time it is called."""
    private = name.startswith("_") or not name.endswith("_")
    return not private and name not in HARMLESS and callable(getattr(torch.Tensor, name, None))


def _methods(model: type) -> set[str]:
    return {name for name in dir(model) if not name.startswith("_") and name not in dir(torch.nn.Module)}
