"""Kernels that run on all cores.

They are C++ (`kernels/*.h`), written with the vector types of Clang; Warp compiles them on first use (`native.py`, up
to a few seconds each). Nothing of them is written in Warp's Python dialect, whose scalar code does not vectorise
across pixels.

Warp executes a CPU launch on the calling thread, but it releases the interpreter lock while the kernel runs.
Every kernel here is therefore a worker: it takes one block of items after the other from shared atomic counters until
none is left, and calling it starts one worker per thread. Blocks are handed out dynamically, so a busy core or
an expensive tile delays nobody, and since no two blocks write to one location the result does not depend on
the number of threads.
"""

import ctypes
import inspect
from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, get_args, get_origin

import torch
from torch import Tensor

from . import guard
from .guard import Sizes
from .native import Kernel, load_kernel
from .source import PRELUDE, SHARED, declare
from .threads import LOCK, get_num_threads, on_threads

# Sections of the items for each thread. Neighbouring items write to the same cache lines: threads that took items in
# turns would pass these lines to and fro.
_SECTIONS = 4
_LINE = 64  # bytes; the counter of each section has a cache line of its own


class FloatArray:
    """Marks a worker's parameter as a contiguous float32 tensor, passed flat."""


class IntArray:
    """Marks a worker's parameter as a contiguous int32 tensor, passed flat."""


class LongArray:
    """Marks a worker's parameter as a contiguous int64 tensor, passed flat."""


class ByteArray:
    """Marks a worker's parameter as a contiguous uint8 tensor, passed flat."""


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
    ByteArray: _Kind(torch.uint8, "wp.uint64", "unsigned char"),
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

    def __init__(self, name: str, kinds: dict[str, type], shapes: dict[str, str], code: str, alone: bool):
        self._name = name
        self._kinds = kinds
        self._sizes = Sizes(name, shapes)
        self._code = code
        self._alone = alone  # on this thread
        self._kernel: Kernel | None = None
        self._checks = [(parameter, kind, _KINDS[kind].dtype) for parameter, kind in kinds.items()]

    def __call__(self, *arguments: Tensor | int | float) -> None:
        values = self._values(arguments)
        if guard.level() == guard.OFF:
            self._run(values)
            return
        named = dict(zip(self._kinds, arguments, strict=True))
        self._sizes.check(named)
        if guard.level() == guard.SIZES:
            self._run(values)
        else:
            guard.run_between_zones(self._name, named, lambda inside: self._run(self._values(inside)))

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
                    address = argument.data_ptr()
                    if not address and argument.numel():  # a tensor by name, which keeps its numbers elsewhere
                        raise TypeError(self._wrong(parameter, argument))
                    values.append(address)
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

    def _run(self, values: list[int | float]) -> None:
        with LOCK:
            if self._kernel is None:
                self._kernel = self._load()
            kernel, threads = self._kernel, 1 if self._alone else get_num_threads()
            sections = _SECTIONS * threads if threads > 1 else 1
            counters = (ctypes.c_int32 * (_LINE // 4 * (sections + 2)))()
            counters[_LINE // 4] = sections
            # Every call fills a block of parameters of its own, which the threads share.
            block = kernel.block(ctypes.addressof(counters) + _LINE, *values)
            on_threads(threads, kernel, block)

    def _load(self) -> Kernel:
        parameters = {"counters_address": "wp.uint64"}
        pointers = "int* counters = (int*)counters_address;\n"
        for name, kind in self._kinds.items():
            _, type_in_warp, pointer = _KINDS[kind]
            if pointer:
                parameters[f"{name}_address"] = type_in_warp
                pointers += f"{pointer}* __restrict {name} = ({pointer}*){name}_address;\n"
            else:
                parameters[name] = type_in_warp
        return load_kernel(self._name, parameters, PRELUDE + pointers + self._code)


def worker(
    code: str,
    *,
    items: str,
    grain: str | int,
    name: str | None = None,
    constants: dict[str, int | float] | None = None,
) -> Callable[[Callable[..., None]], Worker]:
    """Turns a stub function into a `Worker`.

    The stub's parameters are annotated `FloatArray`, `IntArray`, `LongArray`, `ByteArray`, `int` or `float`; arrays
    also `Annotated[FloatArray, "n, 3"]` with the sizes that `guard.Sizes` checks.

    Args:
        code: C++ that handles items `[first, last)`; array parameters of the stub are pointers of their name. It knows
            what `simd.h` defines, the constants of `constants.py` and the optimizations by name.
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
        return Worker(name or stub.__name__, kinds, shapes, loop, alone=items == "1")

    return build
