"""Find out whether an optimizer's step reads the settings of its groups; if not, larger steps have no effect."""

from __future__ import annotations

import inspect
import math
import types
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from skipgs_plug.core.pace.parts import SQUARES_KEPT

MISSING = object()


class WatchedGroup(dict[str, Any]):
    """A copy that replaces a parameter group for one step and records which settings were read.

    Attributes:
        group: The group itself, which receives everything that is written.
        read: Keys that were read.
    """

    def __init__(self, group: dict[str, Any]) -> None:
        super().__init__(group)
        self.group = group
        self.read: set[str] = set()

    def __getitem__(self, key: str) -> Any:
        self.read.add(key)
        return super().__getitem__(key)

    def get(self, key: str, default: Any = None) -> Any:
        self.read.add(key)
        return super().get(key, default)

    def __iter__(self) -> Iterator[str]:
        self.read.update(super().keys())
        return super().__iter__()

    def keys(self) -> Any:
        self.read.update(super().keys())
        return super().keys()

    def items(self) -> Any:
        self.read.update(super().keys())
        return super().items()

    def values(self) -> Any:
        self.read.update(super().keys())
        return super().values()

    def copy(self) -> dict[str, Any]:
        self.read.update(super().keys())
        return dict(super().items())

    def __setitem__(self, key: str, value: Any) -> None:
        super().__setitem__(key, value)
        self.group[key] = value

    def setdefault(self, key: str, default: Any = None) -> Any:
        if key not in self:
            self[key] = default
        return self[key]

    def update(self, *args: Any, **kwargs: Any) -> None:
        for key, value in dict(*args, **kwargs).items():
            self[key] = value

    def pop(self, key: str, default: Any = MISSING) -> Any:
        self.read.add(key)
        value = super().pop(key) if default is MISSING else super().pop(key, default)
        self.group.pop(key, None)
        return value


def watch(groups: list[dict[str, Any]]) -> list[WatchedGroup]:
    """Replace the groups of an optimizer by watched copies, and return the copies."""
    watched = [WatchedGroup(group) for group in groups]
    groups[:] = watched
    return watched


def unwatch(groups: list[dict[str, Any]]) -> None:
    """Put the groups themselves back."""
    groups[:] = [group.group if isinstance(group, WatchedGroup) else group for group in groups]


def is_torchs(optimizer: torch.optim.Optimizer) -> bool:
    """Whether the optimizer's step is one of PyTorch's own; these read all settings."""
    return str(getattr(inspect.unwrap(type(optimizer).step), "__module__", "")).startswith("torch.optim")


def shorter_memory(betas: tuple[Any, ...]) -> float:
    """Return the factor on the rate that bounds a step as `SQUARES_KEPT` does, for an optimizer that keeps its beta2.

    The gradient of one view moves a parameter by its rate divided by the root of 1 - beta2 at most.

    Args:
        betas: The optimizer's betas.
    """
    return min(1.0, math.sqrt((1.0 - betas[1]) / (1.0 - SQUARES_KEPT))) if betas[1] > SQUARES_KEPT else 1.0


class LiteralBetas:
    """Replaces betas that a step passes to an extension as literal numbers.

    `SparseGaussianAdam` of the accelerated rasterizers calls `_C.adamUpdate(..., lr, 0.9, 0.999, eps, N, M)`, where
    `_C` is a global name in the module of its `step`. During a step that name is bound to a stand-in, whose functions
    replace the pair among their arguments.

    Args:
        optimizer: The optimizer.
        betas: The pair that its step passes. The second number becomes `SQUARES_KEPT`.

    Attributes:
        replaced: Number of calls so far in which the pair was replaced.
    """

    def __init__(self, optimizer: torch.optim.Optimizer, betas: tuple[float, float]) -> None:
        self._betas = (float(betas[0]), float(betas[1]))
        self.replaced = 0
        step = inspect.unwrap(type(optimizer).step)
        self._globals: dict[str, Any] = getattr(step, "__globals__", {})
        names = _names(getattr(step, "__code__", None))
        self._called = [name for name in names if name in self._globals and _is_foreign(self._globals[name])]

    @contextmanager
    def in_place(self) -> Iterator[None]:
        """Replace the pair inside the block."""
        before = {name: self._globals[name] for name in self._called}
        self._globals.update({name: _Caller(value, self._call) for name, value in before.items()})
        try:
            yield
        finally:
            self._globals.update(before)

    def _call(self, function: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        given = list(args)
        for index, value in enumerate(args):
            if isinstance(value, tuple) and value[:2] == self._betas:
                given[index] = (value[0], SQUARES_KEPT, *value[2:])
                break
            if _is_number(value) and (value, *args[index + 1 : index + 2]) == self._betas:
                given[index + 1] = SQUARES_KEPT
                break
        else:
            return function(*args, **kwargs)
        self.replaced += 1
        return function(*given, **kwargs)


class _Caller:
    """Stand-in for a module, or for a function of a module, whose calls go through `call`."""

    def __init__(self, target: Any, call: Any) -> None:
        self._target, self._through = target, call

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        return self._through(self._target, args, kwargs)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._target, name)
        return _Caller(value, self._through) if callable(value) and not isinstance(value, type) else value


def _names(code: types.CodeType | None) -> list[str]:
    return [] if code is None else list(code.co_names)


def _is_foreign(value: Any) -> bool:
    if isinstance(value, type):
        return False
    name = value.__name__ if isinstance(value, types.ModuleType) else getattr(value, "__module__", None)
    called = isinstance(value, types.ModuleType) or callable(value)
    return called and str(name or "").split(".")[0] not in ("torch", "math", "builtins", "numpy")


def _is_number(value: Any) -> bool:
    return isinstance(value, float)
