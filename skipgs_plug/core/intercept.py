"""Replace names in the code of a trainer, list every replacement, and restore all of them."""

from __future__ import annotations

import contextlib
import functools
import sys
import types
from collections.abc import Callable, Container, Sequence
from typing import Any

import torch

from skipgs_plug.core.caution import cautioned
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

    If the code around a name fails, and not the original function, `on_error` receives the error, and the trainer gets
    the result that it would have without a gate.

    Args:
        expectation: Sentence for errors that says with which upstream version the names were checked.
        on_error: Receives errors of the code around a name, and raises them or releases the gate. None raises them.
    """

    def __init__(self, expectation: str = "", on_error: Callable[[Exception], None] | None = None) -> None:
        self._on_error = on_error
        self._expectation = expectation
        self._undo: list[tuple[str, Callable[[], None]]] = []

    @property
    def names(self) -> list[str]:
        """Names that are replaced at present, as "owner.name"."""
        return [label for label, _ in self._undo]

    def wrap(self, owner: Any, name: str, around: Around) -> None:
        """Call `around(original, *args, **kwargs)` in place of each `owner.name(*args, **kwargs)`.

        Args:
            owner: A class (`original` then takes the instance first), an instance, a module, or the
                namespace dict of a module.
            name: Attribute to replace.
            around: The replacement.

        Raises:
            AdapterMismatchError: The owner has no callable of this name.
            SkipGSError: A gate has replaced the name already.
        """
        label = f"{_describe(owner)}.{name}"
        original = owner.get(name) if isinstance(owner, dict) else getattr(owner, name, None)
        if not callable(original):
            raise AdapterMismatchError(f"{label} does not exist. {self._expectation}".rstrip())
        if getattr(original, _MARK, False):
            raise SkipGSError(f"{label} is gated already: detach() the other gate first.")

        if _is_bound(original, owner):
            # Schedulers of PyTorch use optimizer.step.__func__, so a method must stay a method.
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
            call = Original(original)  # `around` reads the caller's frame, which must be two frames above its own
            try:
                return around(call, *args, **kwargs)
            except Exception as error:
                return self._instead(error, call, args, kwargs)

        setattr(function, _MARK, True)
        self._set(owner, name, function, label)

    def _instead(self, error: Exception, call: Original, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Return the original's result after the code around a call failed; raise an error of the original itself."""
        if call.failed or self._on_error is None:
            raise error
        self._on_error(error)
        return call.result if call.made else call(*args, **kwargs)

    def add_undo(self, label: str, undo: Callable[[], None]) -> None:
        """Add a function that `restore` calls to undo another change."""
        self._undo.append((label, undo))

    def restore(self) -> None:
        """Undo all changes, the latest first. Further calls do nothing.

        An undo may fail, because other code has changed the same thing. The user is warned, and the others follow.
        """
        while self._undo:
            label, undo = self._undo.pop()
            with cautioned(f"Putting back {label}"):
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
    with contextlib.suppress(AttributeError):  # other code removed it already, and further names must be restored
        delattr(owner, name)


def _is_bound(function: Any, owner: Any) -> bool:
    """Whether `function` is a method bound to the instance `owner`."""
    return isinstance(function, types.MethodType) and function.__self__ is owner and not isinstance(owner, type)


def intercept_tensor_backward(
    patches: Patches,
    callers: Container[str],
    gated: Callable[..., Any],
    other: Callable[[str], None] = lambda caller: None,
) -> None:
    """Pass scalar backward calls of functions with these names to `gated`.

    `torch.Tensor.backward` and `torch.autograd.backward` are replaced in the whole process. Calls from other functions,
    such as for a pruning score, and calls on tensors that are not one scalar go to the original. The caller of a
    function `backward` that makes the call, such as `Accelerator.backward` of accelerate, counts as its caller.

    Args:
        patches: List of replacements, to which this one is added.
        callers: Names of the functions that call the training backward.
        gated: Called as `gated(loss, run, keeps_graph=...)` with the loss, a function that runs the real backward, and
            whether its graph is kept, because other code may need it.
        other: Receives the name of another function that calls backward on a scalar, before the call.
    """

    def around(original: Callable[..., Any], tensors: Any, *args: Any, **kwargs: Any) -> Any:
        # Frame 0 is this function, frame 1 the wrapper, frame 2 the caller of backward.
        called_from = sys._getframe(2)
        if called_from.f_globals.get("__name__") == "torch._tensor":  # `Tensor.backward` calls that of autograd
            return original(tensors, *args, **kwargs)
        frame: types.FrameType | None = called_from
        while frame is not None and frame.f_code.co_name == "backward":
            frame = frame.f_back
        loss = tensors[0] if isinstance(tensors, Sequence) and len(tensors) == 1 else tensors
        if frame is None or not isinstance(loss, torch.Tensor) or loss.numel() != 1:
            return original(tensors, *args, **kwargs)
        if (caller := frame.f_code.co_name) in callers:
            return gated(loss, lambda: original(tensors, *args, **kwargs), keeps_graph=_keeps_graph(*args, **kwargs))
        if caller != "__torch_function__":  # of a mode such as that of --cpu, inside the call of a function
            other(caller)
        return original(tensors, *args, **kwargs)

    patches.wrap(torch.Tensor, "backward", around)
    patches.wrap(torch.autograd, "backward", around)


def _keeps_graph(
    gradient: Any = None, retain_graph: bool | None = None, create_graph: bool = False, *_: Any, **others: Any
) -> bool:
    """Whether backward, called with these arguments after the tensor, keeps a graph that other code may need later."""
    kept = create_graph if retain_graph is None else retain_graph
    return kept or others.get("inputs") is not None  # the graph between the loss and other inputs stays whole


def _describe(owner: Any) -> str:
    if isinstance(owner, dict):
        return str(owner.get("__name__", "namespace"))
    if isinstance(owner, types.ModuleType):
        return owner.__name__
    cls = owner if isinstance(owner, type) else type(owner)
    return f"{cls.__module__}.{cls.__qualname__}"
