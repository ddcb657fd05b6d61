"""Tensors that kernels write to: on the CPU, in memory that is not given back between iterations."""

import math
import threading

import torch
from torch import Tensor

from . import guard
from .memory import LARGE, SUPPORTED, Pool
from .threads import LOCK

# Asked for a tensor like one of these, torch takes half the time that it takes to look through options.
_FLOAT, _INT, _LONG = (torch.empty(0, dtype=dtype, device="cpu") for dtype in (torch.float32, torch.int32, torch.int64))

_scratch = threading.local()
_memory = Pool()


def floats(*shape: int) -> Tensor:
    """A float32 tensor with undefined content, whatever the default dtype and device of the process."""
    return _empty(shape, _FLOAT)


def ints(*shape: int) -> Tensor:
    """An int32 tensor with undefined content."""
    return _empty(shape, _INT)


def _empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    if not SUPPORTED or math.prod(shape) * like.itemsize < LARGE:
        return guard.poison(like.new_empty(*shape))
    with LOCK:
        return guard.poison(_memory.empty(shape, like.dtype))


def release_memory() -> None:
    """Gives memory back to the system that tensors of the rasterizer lay in and none lies in now."""
    with LOCK:
        _memory.release()


def longs(*shape: int) -> Tensor:
    """An int64 tensor with undefined content."""
    return _empty(shape, _LONG)


def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """A tensor of zeros."""
    return torch.zeros(shape, dtype=dtype, device="cpu")


def scratch(name: str, *shape: int) -> Tensor:
    """A float buffer with undefined content that this thread reuses whenever it asks for the same name again.

    Fresh memory of many megabytes costs a page fault per 4 KiB, as much as some kernels take. The buffer must not
    outlive the call that asked for it.
    """
    buffers: dict[str, Tensor] = _scratch.__dict__
    size = math.prod(shape)
    if name not in buffers or buffers[name].numel() < size:
        buffers[name] = floats(size)
    return guard.poison(buffers[name][:size].view(shape))
