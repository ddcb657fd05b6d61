"""Tensors that autograd saved for a backward pass, freed when the pass is skipped instead of at the next forward pass.

A backward pass frees the tensors that the forward pass saved; a skipped one does not. Most trainers hold `loss` and
`image` until the next forward pass is done, so two graphs exist at once: 41 % more memory at the peak in a model of
Inria's sizes. PyTorch's hooks for saved tensors wrap each tensor in an object, which is emptied at a skip.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.core.errors import SkipGSError


class _Saved:
    """One saved tensor; None after it is freed."""

    __slots__ = ("tensor", "version")

    def __init__(self, tensor: Tensor) -> None:
        self.tensor: Tensor | None = tensor
        self.version = tensor._version


class SavedGraph:
    """Tracks the tensors that autograd saves between `open` and `close`.

    Only one level of hooks is used, and none inside hooks of the trainer's own.
    """

    def __init__(self) -> None:
        self._open = False
        self._freeing = False

    def open(self) -> None:
        """Begin to track saved tensors in this thread, unless it has begun already or other hooks are active."""
        if self._open:
            return
        top = _top()
        if top is not None:
            other = getattr(top[0], "__self__", None)
            if not isinstance(other, SavedGraph):
                return
            other.close()  # of another gate: one that was never detached, or whose turn comes again
        torch._C._autograd._push_saved_tensors_default_hooks(self._pack, self._unpack)
        self._open = True

    def close(self) -> None:
        """Stop tracking saved tensors."""
        if self._open and _top() is not None and _top()[0] == self._pack:
            torch._C._autograd._pop_saved_tensors_default_hooks()
            self._open = False

    def free(self, loss: Tensor) -> None:
        """Free the tensors saved for the backward pass of a loss; no backward pass can reach them any more."""
        self._freeing = True
        try:
            for node in nodes(loss):
                for name in _saved_names(node.__class__):
                    with contextlib.suppress(RuntimeError):  # freed already, or changed in place since
                        getattr(node, name)  # calls `_unpack`, which empties the tensor that it finds
        finally:
            self._freeing = False

    def _pack(self, tensor: Tensor) -> _Saved:
        return _Saved(tensor)  # small ones too: PyTorch leaves the check of versions to hooks

    def _unpack(self, saved: _Saved) -> Tensor:
        tensor = saved.tensor
        if tensor is None:
            if self._freeing:
                return torch.empty(0)
            raise SkipGSError(
                "A backward needs the graph of a loss whose backward was skipped, and which is freed; call backward on "
                "both losses at once, or compute what they share anew."
            )
        if self._freeing:
            saved.tensor = None
        elif tensor._version != saved.version:
            raise RuntimeError(
                "one of the variables needed for gradient computation has been modified by an inplace operation: "
                f"{tuple(tensor.shape)} is at version {tensor._version}; expected version {saved.version} instead."
            )
        return tensor


def nodes(loss: Tensor) -> Iterator[Any]:
    """Yield every function of the graph behind a loss once."""
    waiting, seen = [loss.grad_fn], set()
    while waiting:
        node = waiting.pop()
        if node is not None and node not in seen:
            seen.add(node)
            waiting += [before for before, _ in node.next_functions]
            yield node


def drop_gradients(loss: Tensor) -> None:
    """Take the gradients of all leaves behind a loss away, so that no optimizer steps with them."""
    for node in nodes(loss):
        leaf = getattr(node, "variable", None)
        if isinstance(leaf, Tensor):
            leaf.grad = None


@functools.cache
def _saved_names(kind: Any) -> tuple[str, ...]:
    """Attributes of a function of autograd that give saved tensors."""
    names = [name for name in dir(kind) if name.startswith("_saved_")]
    return (*names, "saved_tensors") if hasattr(kind, "saved_tensors") else tuple(names)


def _top() -> Any:
    ask = getattr(torch._C._autograd, "_top_saved_tensors_default_hooks", None)
    return (None,) if ask is None else ask(True)
