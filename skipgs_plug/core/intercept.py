"""Replace names in somebody else's code, know every one of them, and put them all back."""

from __future__ import annotations

import contextlib
import functools
import sys
import types
from collections.abc import Callable
from typing import Any

import torch

from skipgs_plug.core.errors import AdapterMismatchError, SkipGSError

Around = Callable[..., Any]  # called as around(original, *args, **kwargs) in place of original(*args, **kwargs)

_MARK = "__skipgs_plug__"
_ABSENT = object()


class Original:
    """A function of the trainer that code of the gate calls. It tells the trainer's errors from the gate's.

    Attributes:
        made: Whether it was called.
        failed: Whether its last call has not returned, so that an error comes from the trainer.
        result: The value that its last call returned.
    """

    __slots__ = ("_function", "failed", "made", "result")

    def __init__(self, function: Callable[..., Any]) -> None:
        self._function = function
        self.made = self.failed = False

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.made = self.failed = True
        self.result = self._function(*args, **kwargs)
        self.failed = False
        return self.result


class Patches:
    """All names that one gate has replaced, in order.

    Where code that was put around a name fails, and not the name itself, `on_error` is told, and the trainer gets what
    it would have without a gate.

    Args:
        on_error: Told of an error of code around a name; raises it, or has let go of the trainer. None raises it.
        expectation: Sentence for errors: which upstream version the names were checked at.
    """

    def __init__(self, expectation: str = "", on_error: Callable[[Exception], None] | None = None) -> None:
        self._on_error = on_error
        self._expectation = expectation
        self._undo: list[tuple[str, Callable[[], None]]] = []

    @property
    def names(self) -> list[str]:
        """What is replaced at present, as "owner.name"."""
        return [label for label, _ in self._undo]

    def wrap(self, owner: Any, name: str, around: Around) -> None:
        """Call `around(original, *args, **kwargs)` wherever `owner.name(*args, **kwargs)` is called.

        Args:
            owner: A class (`original` then takes the instance first), an instance, a module, or the
                namespace dict of a module.
            name: Attribute to replace.
            around: The replacement.

        Raises:
            AdapterMismatchError: There is no such callable.
            SkipGSError: It is gated already.
        """
        label = f"{_describe(owner)}.{name}"
        original = owner.get(name) if isinstance(owner, dict) else getattr(owner, name, None)
        if not callable(original):
            raise AdapterMismatchError(f"{label} does not exist. {self._expectation}".rstrip())
        if getattr(original, _MARK, False):
            raise SkipGSError(f"{label} is gated already: detach() the other gate first.")

        if _is_bound(original, owner):
            # Schedulers of PyTorch reach for optimizer.step.__func__, so a method stays a method.
            @functools.wraps(original)
            def method(_: Any, *args: Any, **kwargs: Any) -> Any:
                call = Original(original)
                try:
                    return around(call, *args, **kwargs)
                except Exception as error:
                    return self._instead(error, call, args, kwargs)

            setattr(method, _MARK, True)
            self._set(owner, name, types.MethodType(method, owner), label)
            return

        @functools.wraps(original)
        def function(*args: Any, **kwargs: Any) -> Any:
            call = Original(original)  # frame 2 of `around` is the caller's: nothing stands between
            try:
                return around(call, *args, **kwargs)
            except Exception as error:
                return self._instead(error, call, args, kwargs)

        setattr(function, _MARK, True)
        self._set(owner, name, function, label)

    def _instead(self, error: Exception, call: Original, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """What the trainer gets where the code around a call failed; an error of its own call is raised."""
        if call.failed or self._on_error is None:
            raise error
        self._on_error(error)
        return call.result if call.made else call(*args, **kwargs)

    def add_undo(self, label: str, undo: Callable[[], None]) -> None:
        """List something else that `restore` has to take back."""
        self._undo.append((label, undo))

    def restore(self) -> None:
        """Put everything back, latest first. Harmless when called again."""
        while self._undo:
            _, undo = self._undo.pop()
            undo()

    def _set(self, owner: Any, name: str, value: Any, label: str) -> None:
        if isinstance(owner, dict):
            before = owner[name]
            owner[name] = value
            self.add_undo(label, lambda: owner.__setitem__(name, before))
            return
        before = vars(owner).get(name, _ABSENT) if hasattr(owner, "__dict__") else _ABSENT
        setattr(owner, name, value)
        if before is _ABSENT:
            self.add_undo(label, lambda: _remove(owner, name))
        else:
            self.add_undo(label, lambda: setattr(owner, name, before))


def _remove(owner: Any, name: str) -> None:
    with contextlib.suppress(AttributeError):  # somebody was faster, and the rest has to be put back all the same
        delattr(owner, name)


def _is_bound(function: Any, owner: Any) -> bool:
    """Whether `function` is a method bound to the instance `owner`."""
    return isinstance(function, types.MethodType) and function.__self__ is owner and not isinstance(owner, type)


def intercept_tensor_backward(
    patches: Patches, callers: tuple[str, ...], gated: Callable[[torch.Tensor, Callable[[], Any]], Any]
) -> None:
    """Hand the scalar backwards that a function of one of these names calls itself to `gated`.

    `torch.Tensor.backward` is replaced for the process, so everything else passes through: backwards of
    other functions (a pruning score, say), backwards of tensors that are not scalars.

    Args:
        patches: Where the replacement is listed.
        callers: Names of functions that hold the training backward.
        gated: Called with the loss and a function that runs the real backward.
    """

    def around(original: Callable[..., Any], loss: torch.Tensor, *args: Any, **kwargs: Any) -> Any:
        # Frame 0 is this function, 1 the wrapper, 2 whoever called backward.
        if sys._getframe(2).f_code.co_name not in callers or loss.numel() != 1:
            return original(loss, *args, **kwargs)
        return gated(loss, lambda: original(loss, *args, **kwargs))

    patches.wrap(torch.Tensor, "backward", around)


def _describe(owner: Any) -> str:
    if isinstance(owner, dict):
        return str(owner.get("__name__", "namespace"))
    if isinstance(owner, types.ModuleType):
        return owner.__name__
    cls = owner if isinstance(owner, type) else type(owner)
    return f"{cls.__module__}.{cls.__qualname__}"
