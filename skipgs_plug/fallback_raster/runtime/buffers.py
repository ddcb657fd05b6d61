"""Tensors that kernels write to. They lie on the CPU, and the memory of large ones is kept between iterations."""

import math
import threading

import torch
from torch import Tensor

from . import guard
from .memory import POOLED_BYTES, SUPPORTED, Pool
from .threads import LOCK

# `new_empty` of an existing tensor takes half the time of `torch.empty` with options.
_FLOAT, _INT, _LONG = (torch.empty(0, dtype=dtype, device="cpu") for dtype in (torch.float32, torch.int32, torch.int64))

_scratch = threading.local()
_memory = Pool()


def floats(*shape: int) -> Tensor:
    """Return a float32 tensor with undefined content. The default dtype and device of the process do not matter."""
    return _empty(shape, _FLOAT)


def ints(*shape: int) -> Tensor:
    """Return an int32 tensor with undefined content."""
    return _empty(shape, _INT)


def _empty(shape: tuple[int, ...], like: Tensor) -> Tensor:
    if not SUPPORTED or math.prod(shape) * like.itemsize < POOLED_BYTES:
        return guard.poison(like.new_empty(*shape))
    with LOCK:
        return guard.poison(_memory.empty(shape, like.dtype))


def release_memory() -> None:
    """Return memory that no tensor of the rasterizer uses any more to the operating system."""
    with LOCK:
        _memory.release()


def longs(*shape: int) -> Tensor:
    """Return an int64 tensor with undefined content."""
    return _empty(shape, _LONG)


def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    """Return a tensor of zeros."""
    return torch.zeros(shape, dtype=dtype, device="cpu")


def scratch(name: str, *shape: int) -> Tensor:
    """Return a float32 buffer with undefined content, which this thread reuses for every call with the same name.

    New memory of many megabytes costs a page fault per 4 KiB, as much time as some kernels take. The buffer must not
    outlive the call that requested it.
    """
    buffers: dict[str, Tensor] = _scratch.__dict__
    size = math.prod(shape)
    if name not in buffers or buffers[name].numel() < size:
        buffers[name] = floats(size)
    return guard.poison(buffers[name][:size].view(shape))
