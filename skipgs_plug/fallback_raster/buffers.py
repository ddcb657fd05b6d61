"""Tensors that kernels write to: on the CPU, in memory that is not given back between iterations."""

import math
import threading

import torch
from torch import Tensor

from . import guard
from .memory import LARGE, SUPPORTED, Pool
from .threads import LOCK

_scratch = threading.local()
_memory = Pool()


def floats(*shape: int) -> Tensor:
    """A float32 tensor with undefined content, whatever the default dtype and device of the process."""
    return _empty(shape, torch.float32)


def ints(*shape: int) -> Tensor:
    """An int32 tensor with undefined content."""
    return _empty(shape, torch.int32)


def _empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    if not SUPPORTED or math.prod(shape) * dtype.itemsize < LARGE:
        return guard.poison(torch.empty(shape, dtype=dtype, device="cpu"))
    with LOCK:
        return guard.poison(_memory.empty(shape, dtype))


def release_memory() -> None:
    """Gives memory back to the system that tensors of the rasterizer lay in and none lies in now."""
    with LOCK:
        _memory.release()


def longs(*shape: int) -> Tensor:
    """An int64 tensor with undefined content."""
    return _empty(shape, torch.int64)


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
