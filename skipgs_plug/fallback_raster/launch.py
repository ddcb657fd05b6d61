"""Kernels that run on all cores.

Warp executes a CPU launch on the calling thread, but it releases the interpreter lock while the kernel runs.
Every kernel here is therefore a worker: it takes the next block of items from a shared atomic counter until
none is left, and calling it starts one worker per thread. Blocks are handed out dynamically, so a busy core or
an expensive tile delays nobody, and since no two blocks write to one location the result does not depend on
the number of threads.

The bodies are C++ with vector types (see `simd.py`), compiled by Warp's own Clang on first use (up to a few
seconds each) and cached on disk; no compiler has to be installed.
"""

import functools
import importlib
import inspect
import linecache
import math
import os
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.install import install_command

from .simd import PRELUDE

# A counter fills a cache line, so that nothing else is slowed down by it.
_COUNTER_SIZE = 16

_lock = threading.RLock()
_scratch = threading.local()
_num_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
_pool: ThreadPoolExecutor | None = None


def get_num_threads() -> int:
    """Number of threads that the CPU rasterizer runs on; all cores of this process unless set."""
    return _num_threads


def set_num_threads(n: int) -> None:
    """Sets the number of threads of the CPU rasterizer. Images and gradients are bit-equal for any number.

    Args:
        n: At least 1.

    Raises:
        ValueError: `n` is not a whole number of at least 1.
    """
    global _num_threads, _pool
    if not isinstance(n, int) or n < 1:
        raise ValueError(f"set_num_threads expects a whole number of at least 1, got {n!r}.")
    with _lock:
        _num_threads = n
        if _pool is not None:
            _pool.shutdown()
            _pool = None


def scratch(name: str, *shape: int) -> Tensor:
    """A float buffer with undefined content that this thread reuses whenever it asks for the same name again.

    Fresh memory of many megabytes costs a page fault per 4 KiB, as much as some kernels take. The buffer must not
    outlive the call that asked for it.
    """
    buffers: dict[str, Tensor] = _scratch.__dict__
    size = math.prod(shape)
    if name not in buffers or buffers[name].numel() < size:
        buffers[name] = torch.empty(size)
    return buffers[name][:size].view(shape)


class FloatArray:
    """Marks a worker's parameter as a contiguous float32 tensor, passed flat."""


class IntArray:
    """Marks a worker's parameter as a contiguous int32 tensor, passed flat."""


# Arrays travel as addresses: describing them to Warp takes longer than some kernels run.
_WARP_TYPE = {FloatArray: "wp.uint64", IntArray: "wp.uint64", int: "wp.int32", float: "wp.float32"}
_POINTER = {FloatArray: "float", IntArray: "int"}


class Worker:
    """A kernel made of C++; call it with its parameters to run it on every thread. See `worker`."""

    def __init__(self, name: str, kinds: dict[str, type], code: str):
        self._name = name
        self._kinds = kinds
        self._code = code
        self._command: Any = None

    def __call__(self, *arguments: Tensor | int | float) -> None:
        with _lock:
            if self._command is None:
                self._command = self._record()
            # Named, because an address does not keep a tensor alive.
            counter = torch.zeros(_COUNTER_SIZE, dtype=torch.int32)
            self._command.set_params_from_ctypes([_parameter(a) for a in (counter, *arguments)])
            _on_all_threads(self._command.launch)

    def _record(self) -> Any:
        wp = _warp()
        declared = {"counter_address": _WARP_TYPE[IntArray]}
        pointers = "int* counter = (int*)counter_address;\n"
        for name, kind in self._kinds.items():
            if kind in _POINTER:
                declared[f"{name}_address"] = _WARP_TYPE[kind]
                pointers += f"{_POINTER[kind]}* __restrict {name} = ({_POINTER[kind]}*){name}_address;\n"
            else:
                declared[name] = _WARP_TYPE[kind]
        signature = ", ".join(f"{name}: {kind}" for name, kind in declared.items())
        source = f"def {self._name}_body({signature}): ...\n"
        source += f"def {self._name}({signature}):\n    {self._name}_body({', '.join(declared)})\n"
        # Warp reads a kernel's source back through `inspect`, which finds generated code in `linecache`.
        filename = f"<skipgs_plug {self._name}>"
        linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
        namespace: dict[str, Any] = {"wp": wp, "__name__": f"{__name__}.{self._name}"}
        exec(compile(source, filename, "exec"), namespace)
        body = namespace[f"{self._name}_body"]
        namespace[f"{self._name}_body"] = wp.func_native(PRELUDE + pointers + self._code)(body)
        kernel = wp.kernel(enable_backward=False)(namespace[self._name])
        inputs = [0] * len(declared)
        return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)


def worker(code: str, *, items: str, grain: int, name: str | None = None) -> Callable[[Callable[..., None]], Worker]:
    """Turns a stub function into a `Worker`.

    Args:
        code: C++ that handles items `[first, last)`; array parameters of the stub are pointers of their name.
        items: C++ expression for the number of items, in terms of the stub's parameters.
        grain: Items taken from the counter at a time.
        name: Name of the kernel where the stub's own is not unique.
    """
    loop = f"""
for (;;) {{
    const int first = __atomic_fetch_add(counter, {grain}, __ATOMIC_RELAXED);
    if (first >= ({items})) break;
    const int last = first + {grain} < ({items}) ? first + {grain} : ({items});
    {code}
}}
"""

    def build(stub: Callable[..., None]) -> Worker:
        kinds = {
            name: parameter.annotation for name, parameter in inspect.signature(stub, eval_str=True).parameters.items()
        }
        return Worker(name or stub.__name__, kinds, loop)

    return build


@functools.cache
def _warp() -> Any:
    try:
        wp: Any = importlib.import_module("warp")
    except ImportError as error:
        raise ImportError(f"The CPU rasterizer needs NVIDIA Warp: {install_command()}.") from error
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR
    with _quiet_stderr():
        wp.init()
    return wp


@contextmanager
def _quiet_stderr() -> Iterator[None]:
    """Drops what native code writes to stderr inside the block.

    Warp's library warns there that it found no CUDA driver, which a rasterizer for machines without one expects.
    """
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _parameter(value: Tensor | int | float) -> int | float:
    if isinstance(value, Tensor):
        assert value.is_contiguous(), "kernels read and write contiguous tensors only"
        return value.data_ptr()
    return value


def _on_all_threads(work: Callable[[], None]) -> None:
    global _pool
    if _num_threads == 1:
        work()
        return
    if _pool is None:
        _pool = ThreadPoolExecutor(_num_threads - 1, thread_name_prefix="skipgs-raster")
    others = [_pool.submit(work) for _ in range(_num_threads - 1)]
    work()
    for other in others:
        # A worker that has not started by now would find no item left.
        if not other.cancel():
            other.result()
