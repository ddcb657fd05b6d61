"""Kernels that run on all cores.

They are C++ (`kernels/*.h`), written with the vector types of Clang. Warp compiles them with its own Clang on first
use (up to a few seconds each), caches them on disk and launches them; no compiler has to be installed. Nothing of
them is written in Warp's Python dialect, whose scalar code does not vectorise across pixels.

Warp executes a CPU launch on the calling thread, but it releases the interpreter lock while the kernel runs.
Every kernel here is therefore a worker: it takes one block of items after the other from shared atomic counters until
none is left, and calling it starts one worker per thread. Blocks are handed out dynamically, so a busy core or
an expensive tile delays nobody, and since no two blocks write to one location the result does not depend on
the number of threads.
"""

import ctypes
import functools
import importlib
import inspect
import linecache
import math
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import torch
from torch import Tensor

from skipgs_plug.install import install_command

from . import guard
from .cache import load_or_rebuild, say_unwritable
from .cores import usable_cores
from .guard import Sizes
from .memory import LARGE, SUPPORTED, Pool
from .source import PRELUDE, SHARED, declare

_lock = threading.RLock()
_scratch = threading.local()
_memory = Pool()
_num_threads = usable_cores()
_pool: ThreadPoolExecutor | None = None
_busy = False  # threads of the pool may still be at work
_forked = False  # this process inherited torch's OpenMP without its threads, and has not been told so

# Sections of the items for each thread. Neighbouring items write to the same cache lines: threads that took items in
# turns would pass these lines to and fro.
_SECTIONS = 4
_LINE = 64  # bytes; the counter of each section has a cache line of its own


def get_num_threads() -> int:
    """Number of threads that the CPU rasterizer runs on; all cores this process may use unless set."""
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


def floats(*shape: int) -> Tensor:
    """A float32 tensor with undefined content, whatever the default dtype and device of the process."""
    return _empty(shape, torch.float32)


def ints(*shape: int) -> Tensor:
    """An int32 tensor with undefined content."""
    return _empty(shape, torch.int32)


def _empty(shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    if not SUPPORTED or math.prod(shape) * dtype.itemsize < LARGE:
        return guard.poison(torch.empty(shape, dtype=dtype, device="cpu"))
    with _lock:
        return guard.poison(_memory.empty(shape, dtype))


def release_memory() -> None:
    """Gives memory back to the system that tensors of the rasterizer lay in and none lies in now."""
    with _lock:
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


class FloatArray:
    """Marks a worker's parameter as a contiguous float32 tensor, passed flat."""


class IntArray:
    """Marks a worker's parameter as a contiguous int32 tensor, passed flat."""


class LongArray:
    """Marks a worker's parameter as a contiguous int64 tensor, passed flat."""


class _Kind(NamedTuple):
    """What a parameter is in Python, in Warp and in C++."""

    dtype: torch.dtype | None  # of a tensor
    warp: str
    pointer: str


# Arrays travel as addresses: describing them to Warp takes longer than some kernels run.
_KINDS: dict[type, _Kind] = {
    FloatArray: _Kind(torch.float32, "wp.uint64", "float"),
    IntArray: _Kind(torch.int32, "wp.uint64", "int"),
    LongArray: _Kind(torch.int64, "wp.uint64", "long long"),
    int: _Kind(None, "wp.int32", ""),
    float: _Kind(None, "wp.float32", ""),
}


class Worker:
    """A kernel made of C++; call it with its parameters to run it on every thread. See `worker`.

    A call checks the number of arguments and the type, layout, dtype and device of each; what Warp and the kernel get
    are bare addresses. Sizes are checked where `guard.py` is on.

    Raises:
        TypeError: Arguments are missing, too many, or not of the declared kind.
    """

    def __init__(self, name: str, kinds: dict[str, type], shapes: dict[str, str], code: str):
        self._name = name
        self._kinds = kinds
        self._sizes = Sizes(name, shapes)
        self._code = code
        self._command: Any = None
        self._checks = [(parameter, kind, _KINDS[kind].dtype) for parameter, kind in kinds.items()]

    def __call__(self, *arguments: Tensor | int | float) -> None:
        values = self._values(arguments)
        if guard.level() == guard.OFF:
            self._run(values, arguments)
            return
        named = dict(zip(self._kinds, arguments, strict=True))
        self._sizes.check(named)
        if guard.level() == guard.SIZES:
            self._run(values, arguments)
        else:
            guard.run_between_zones(self._name, named, lambda inside: self._run(self._values(inside), inside))

    def _values(self, arguments: tuple[Any, ...]) -> list[int | float]:
        """Addresses of tensors, and numbers, in the order of the parameters."""
        values: list[int | float] = []
        try:
            checks: Any = zip(self._checks, arguments, strict=True)
            for (parameter, kind, dtype), argument in checks:
                if dtype is None:
                    if type(argument) is not kind:
                        raise TypeError(self._wrong(parameter, argument))
                    if kind is int and not -0x80000000 <= argument <= 0x7FFFFFFF:
                        raise OverflowError(f"{self._name}: {parameter} = {argument} does not fit into 32 bits.")
                    values.append(argument)
                else:
                    if argument.dtype is not dtype or not argument.is_cpu or not argument.is_contiguous():
                        raise TypeError(self._wrong(parameter, argument))
                    values.append(argument.data_ptr())
        except ValueError:
            raise TypeError(f"{self._name} takes {len(self._checks)} arguments, got {len(arguments)}.") from None
        except AttributeError:
            raise TypeError(self._wrong(parameter, argument)) from None
        return values

    def _wrong(self, parameter: str, argument: Any) -> str:
        kind = self._kinds[parameter]
        dtype = _KINDS[kind].dtype
        wanted = kind.__name__ if dtype is None else f"contiguous tensor of {dtype} on the CPU"
        if not isinstance(argument, Tensor):
            return f"{self._name}: {parameter} must be a {wanted}, got {type(argument).__name__} {argument!r:.40}."
        layout = "contiguous" if argument.is_contiguous() else f"strides {argument.stride()}"
        return f"{self._name}: {parameter} must be a {wanted}, got {argument.dtype} on {argument.device}, {layout}."

    def _run(self, values: list[int | float], arguments: tuple[Any, ...]) -> None:
        with _lock:
            if self._command is None:
                self._command = self._record()
            if _forked:
                _warn_after_fork()
            command, bounds, parameters = self._command
            sections = _SECTIONS * _num_threads if _num_threads > 1 else 1
            counters = (ctypes.c_int32 * (_LINE // 4 * (sections + 2)))()
            counters[_LINE // 4] = sections
            block = parameters(ctypes.addressof(counters) + _LINE, *values)

            # What a thread needs lives as long as its work: an exception may end this call before they do.
            def work(owned: Any = (counters, arguments)) -> None:
                command.hooks.forward(bounds, ctypes.byref(block))

            _on_all_threads(work)

    def _record(self) -> Any:
        wp = _warp()
        declared = {"counters_address": "wp.uint64"}
        pointers = "int* counters = (int*)counters_address;\n"
        for name, kind in self._kinds.items():
            _, type_in_warp, pointer = _KINDS[kind]
            if pointer:
                declared[f"{name}_address"] = type_in_warp
                pointers += f"{pointer}* __restrict {name} = ({pointer}*){name}_address;\n"
            else:
                declared[name] = type_in_warp
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
        # Warp compiles for blocks of one thread on the CPU.
        folder = Path(wp.config.kernel_cache_dir) / kernel.module.get_module_identifier(1)

        def load() -> Any:
            with say_unwritable():
                return wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True, record_tape=False)

        command = load_or_rebuild(folder, load, kernel.module.unload)
        # Every call fills a block of parameters of its own, which the threads share.
        bounds, *parameters = command.params
        fields = [(name, type(parameter)) for name, parameter in zip(declared, parameters, strict=True)]
        block = type(f"{self._name}_parameters", (ctypes.Structure,), {"_fields_": fields})
        return command, ctypes.byref(bounds), block


def worker(
    code: str,
    *,
    items: str,
    grain: str | int,
    name: str | None = None,
    constants: dict[str, int | float] | None = None,
) -> Callable[[Callable[..., None]], Worker]:
    """Turns a stub function into a `Worker`.

    The stub's parameters are annotated `FloatArray`, `IntArray`, `LongArray`, `int` or `float`; arrays
    also `Annotated[FloatArray, "n, 3"]` with the sizes that `guard.Sizes` checks.

    Args:
        code: C++ that handles items `[first, last)`; array parameters of the stub are pointers of their name. It knows
            what `simd.h` defines, the constants of `constants.py` and the shortcuts by name.
        items: C++ expression for the number of items, in terms of the stub's parameters.
        grain: Items taken at a time, a number or C++.
        name: Name of the kernel where the stub's own is not unique.
        constants: More of them, of this kernel alone.
    """
    # A thread takes its own sections in their order, then the others' from behind, where their owner comes last. Names
    # end in an underscore so that they hide none of the stub's.
    loop = f"""{declare(SHARED | (constants or {}))}
const int sections_ = counters[0], thread_ = __atomic_fetch_add(counters + 1, 1, __ATOMIC_RELAXED);
const long long step_ = {grain}, steps_ = (({items}) + step_ - 1) / step_;
for (int turn_ = 0; turn_ < sections_; ++turn_) {{
    const int ahead_ = turn_ < {_SECTIONS} ? turn_ : sections_ + {_SECTIONS} - 1 - turn_;
    const int section_ = (thread_ * {_SECTIONS} + ahead_) % sections_;
    const int begin_ = (int)(steps_ * section_ / sections_), end_ = (int)(steps_ * (section_ + 1) / sections_);
    for (;;) {{
        const int at_ = begin_ + __atomic_fetch_add(counters + {_LINE // 4} * (section_ + 1), 1, __ATOMIC_RELAXED);
        if (at_ >= end_) break;
        const int first = (int)(at_ * step_), last = smaller(first + (int)step_, {items});
{code}
    }}
}}
"""

    def build(stub: Callable[..., None]) -> Worker:
        kinds, shapes = {}, {}
        for parameter in inspect.signature(stub, eval_str=True).parameters.values():
            kind = parameter.annotation
            if get_origin(kind) is Annotated:
                kind, shapes[parameter.name] = get_args(kind)
            kinds[parameter.name] = kind
        return Worker(name or stub.__name__, kinds, shapes, loop)

    return build


@functools.cache
def _warp() -> Any:
    try:
        wp: Any = importlib.import_module("warp")
    except ImportError as error:
        raise ImportError(f"The CPU rasterizer needs NVIDIA Warp: {install_command()}.") from error
    wp.config.quiet = True
    wp.config.log_level = wp.LOG_ERROR
    with _quiet_stderr(), say_unwritable():
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


def _on_all_threads(work: Callable[[], None]) -> None:
    """Runs `work` on every thread and returns when all are done, also when an exception arrives meanwhile.

    KeyboardInterrupt and what signal handlers raise may come between any two steps, and another one while the threads
    are awaited. So the pool counts as busy until all is known to be done, and the next call waits for it.
    """
    global _pool, _busy
    if _num_threads == 1:
        work()
        return
    if _busy and _pool is not None:
        _pool.shutdown()
        _pool = None
    if _pool is None:
        _pool = _start_pool(_num_threads - 1)
    others: list[Future[None]] = []
    _busy = True
    try:
        for _ in range(_num_threads - 1):
            others.append(_pool.submit(work))
        work()
    finally:
        for other in others:
            # A worker that has not started by now would find no item left.
            if not other.cancel():
                other.result()
    _busy = False


def _start_pool(count: int) -> ThreadPoolExecutor:
    """Start so many threads, from another thread than this one.

    Exceptions of signal handlers come to the main thread alone. One that came while it starts a worker would leave a
    thread that the pool does not know of, for which the interpreter waits at its end without telling it to stop.
    """
    pool = ThreadPoolExecutor(count, thread_name_prefix="skipgs-raster")
    started = threading.Event()

    def start() -> None:
        # An interrupted process may be at its end by now, where nothing can be submitted any more.
        with suppress(RuntimeError):
            for _ in range(count):
                pool.submit(started.wait)  # a worker that waits does not take the next one's place
        started.set()

    starter = threading.Thread(target=start, name="skipgs-raster-start")
    starter.start()
    starter.join()
    return pool


def _warn_after_fork() -> None:
    global _forked
    _forked = False
    warnings.warn(
        "This process was forked from one in which torch had several threads, which do not survive a fork: torch "
        'may hang here. Start processes with multiprocessing\'s "spawn", or call torch.set_num_threads(1) first.',
        RuntimeWarning,
        stacklevel=4,
    )


def _after_fork_in_child() -> None:
    """Threads do not survive a fork: a child starts its own."""
    global _pool, _busy, _forked
    _pool, _busy = None, False
    _forked = torch.get_num_threads() > 1
    _lock.release()


# A child must not inherit the lock from a thread that renders; so a fork waits until it has finished.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_after_fork_in_child)
