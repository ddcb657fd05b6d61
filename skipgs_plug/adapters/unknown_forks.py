"""Find what a trainer does beyond its adapter's knowledge, name it, and start the gate after it."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any, NamedTuple

import torch

from skipgs_plug.adapters.loop_bounds import ASSIGNED, CallReader, undecorated
from skipgs_plug.adapters.loop_code import LoopCode
from skipgs_plug.core.caution import caution
from skipgs_plug.core.errors import AdapterMismatchError
from skipgs_plug.core.hooks import Adapter

NOISE = frozenset({"randn", "randn_like", "normal"})
# Methods of a tensor that change no values.
HARMLESS = frozenset({"requires_grad_", "share_memory_", "detach_", "rename_"})
# Methods of the model that Inria's loops (classic and current) call, and arguments that they pass to `render` by name.
CALLS = frozenset(
    {
        "add_densification_stats",
        "capture",
        "densify_and_prune",
        "get_opacity",
        "get_rotation",
        "get_scaling",
        "get_xyz",
        "oneupSHdegree",
        "restore",
        "training_setup",
        "update_learning_rate",
    }
)
ARGUMENTS = frozenset({"scaling_modifier", "override_color", "separate_sh", "use_trained_exp"})
BY_HAND = "Gate it by hand with SkipGate(start_iter=...), or write an adapter (CONTRIBUTING.md)."


class Unrecognised(NamedTuple):
    """Parts of a loop of the Inria family that its adapter does not know.

    Attributes:
        calls: Methods of the model.
        arguments: Arguments of the renderer.
        noise: Functions that draw random numbers.
        writes: Methods that change a tensor in place, and `data` if the loop assigns to it.
        known: Names that the adapter did recognise.
    """

    calls: frozenset[str]
    arguments: frozenset[str]
    noise: frozenset[str]
    writes: frozenset[str]
    known: frozenset[str]

    def refuse(self, who: str) -> None:
        """Refuse a loop that changes tensors itself. Noise alone is accepted, since it may be input of a network.

        Args:
            who: Beginning of the sentence.

        Raises:
            AdapterMismatchError: The loop writes into tensors.
        """
        if self.writes:
            names = ", ".join(sorted(self.writes | self.noise))
            raise AdapterMismatchError(
                f"{who}: its loop changes values itself ({names}), which would go on alone in skipped iterations. "
                f"{BY_HAND}"
            )

    @property
    def listed(self) -> list[str]:
        """The unrecognised parts, spelled for a sentence."""
        return [
            *(f"render({name}=)" for name in sorted(self.arguments)),
            *(spelled(name) for name in sorted(self.calls | self.noise)),
        ]


def unrecognised(
    code: LoopCode,
    renderers: Iterable[Callable[..., object]],
    model: type,
    calls: Iterable[str],
    arguments: Iterable[str],
) -> Unrecognised:
    """Compare a loop, and the functions that it calls, with the names that its adapter knows.

    Args:
        code: The training script.
        renderers: Its renderers.
        model: Its GaussianModel.
        calls: Names that the adapter knows beyond those of Inria's loop: methods of the model, functions that draw
            noise, methods that change tensors in place.
        arguments: Arguments of the renderers that the adapter knows beyond those of Inria's loop.
    """
    known = CALLS | set(calls)
    parameters = {name for one in renderers for name in inspect.signature(one).parameters}
    writes = {name for name in code.repeated if writes_in_place(name)} | ({"data"} & code.stored)
    return Unrecognised(
        frozenset(code.repeated & _methods(model) - known),
        frozenset(code.keywords & parameters - ARGUMENTS - set(arguments)),
        frozenset(code.repeated & NOISE - known),
        frozenset(writes - known),
        frozenset(code.used & known),
    )


class Survey:
    """Compares the calls of a trainer object with the ones that its adapter knows.

    A fork that adds a method to the model, or calls a known one until later, has the same names as its parent
    otherwise, so it is taken for its parent. The survey names what it adds, and puts the start of the gate off.

    Args:
        adapter: The adapter, for sentences.
        owners: Classes, and modules with functions, through which the model changes.
        known: Their methods and functions that the trainer of the adapter calls.
        changes: Further ones, which change the model until densification ends.
        through: Further ones, which are read too: they call changes, in some iterations. No others are read.
        windows: As for `CallReader`.
    """

    def __init__(
        self,
        adapter: Adapter,
        owners: Iterable[Any],
        known: Iterable[str],
        changes: Iterable[str],
        through: Iterable[str] = (),
        windows: Collection[str] = (),
    ) -> None:
        self._adapter = adapter
        self._changes = frozenset(changes)
        self._known = self._changes.union(known, through)
        owners = list(owners)
        self._methods = {ASSIGNED}.union(*map(_callables, owners))
        self._reader = CallReader(map(_project, owners), self._methods.difference(through), windows)

    def read(
        self, function: Any, *numbers: str, values: Mapping[str, Any] | None = None, end: int | None = None
    ) -> None:
        """Read a function or bound method of the trainer, and the functions of its project that it calls.

        Args:
            function: The function.
            *numbers: Expressions that hold the iteration's number in it, as they stand in its source.
            values: Values of its names, as far as they are known.
            end: First iteration that is too late for this function; None if it is called to the end.
        """
        plain = undecorated(function)
        if plain is not None:
            self._reader.projects.add(_project(plain))
            self._reader.note(plain.__name__, end)
            self._reader.read(function, numbers, values or {}, end)

    @property
    def unknown(self) -> list[str]:
        """The calls that the adapter does not know, but for getters."""
        called = self._reader.ends.keys() & self._methods - self._known
        return sorted(name for name in called if not name.startswith("get_"))

    def start_after_changes(self, start: int, last: float = math.inf, unit: int = 1) -> int:
        """Return `start`, or the end of the last known or unknown change of the model, if that is later.

        Says what was not recognised, and why the gate starts later.

        Args:
            start: First iteration after densification, by the trainer's options.
            last: Last iteration of the run, if it is known.
            unit: Iterations in one step of the numbers that are read, such as the views of an epoch.
        """
        if self.unknown:
            name, checked = self._adapter.name, self._adapter.checked.partition(" (")[0]
            recognised = sorted(self._reader.ends.keys() & self._known) or ["no call of the model"]
            caution(
                f"The trainer does more than {checked}, which adapter {name!r} is for. Recognised: "
                f"{', '.join(recognised)}. {left_alone(map(spelled, self.unknown))}"
            )
        names = self._changes.union(self.unknown)
        ends = {name: end * unit for name, end in self._reader.ends.items() if end is not None and name in names}
        return begin_after(start, last, ends)


def left_alone(names: Iterable[str]) -> str:
    """Return the sentence about calls that were not recognised."""
    return f"Not recognised, and left to go on in skipped iterations: {', '.join(names)}."


def spelled(name: str) -> str:
    """Return a call as a sentence shows it."""
    return "an assignment to data" if name == ASSIGNED else f"{name}()"


def begin_after(start: int, last: float, ends: Mapping[str, int]) -> int:
    """Return the first iteration after `start` and after all of these ends; say so if it is later than `start`.

    Args:
        start: First iteration that may be skipped as far as the adapter knows.
        last: Last iteration of the run. What ends after it goes on to the end, and is not waited for.
        ends: First iteration that is too late for each call.
    """
    late = {name: end for name, end in ends.items() if start < end <= last}
    if late:
        listed = ", ".join(f"{spelled(name)} until iteration {end - 1}" for name, end in sorted(late.items()))
        caution(f"The gate begins with iteration {max(late.values())} in place of {start}: the loop calls {listed}.")
    return max([start, *late.values()])


def _project(part: Any) -> str:
    """Top-level package of a class, function or module."""
    return str(getattr(part, "__module__", None) or part.__name__).partition(".")[0]


def _callables(owner: Any) -> set[str]:
    """Names of the methods of a class, or of the functions of a module."""
    inherited = set(dir(torch.nn.Module)) if inspect.isclass(owner) else set()
    names = {name for name in dir(owner) if not name.startswith("__")} - inherited
    functions = {name: undecorated(inspect.getattr_static(owner, name, None)) for name in names}
    own = owner.__name__ if inspect.ismodule(owner) else None  # a module has names of others, too
    return {name for name, one in functions.items() if one is not None and own in (None, one.__module__)}


def writes_in_place(name: str) -> bool:
    """Whether this is the name of a method that changes the values of a tensor in place."""
    private = name.startswith("_") or not name.endswith("_")
    return not private and name not in HARMLESS and callable(getattr(torch.Tensor, name, None))


def _methods(model: type) -> set[str]:
    return {name for name in dir(model) if not name.startswith("_") and name not in dir(torch.nn.Module)}
