"""Kernels that run on all cores.

They are C++ (`kernels/*.h`), written with the vector types of Clang; Warp compiles them on first use (`native.py`, up
to a few seconds each). Nothing of them is written in Warp's Python dialect, whose scalar code does not vectorise
across pixels.

Warp executes a CPU launch on the calling thread, but it releases the interpreter lock while the kernel runs.
Every kernel here is therefore a worker: it takes a few items after the other from shared atomic counters until
none is left, and calling it starts one worker per thread. Items are handed out dynamically, so a busy core or
an expensive tile delays nobody, and since no two items write to one location the result does not depend on
the number of threads.
"""

import ctypes
import inspect
import threading
from collections.abc import Callable
from typing import Any, Generic, ParamSpec

from torch import Tensor

from . import guard
from .guard import Sizes
from .native import Kernel, load_kernel
from .parameters import ArrayKind, Parameter, call_reader, declare_struct, group, parameters_of, structs_of
from .source import PRELUDE, SHARED, declare, read_kernel
from .threads import LOCK, get_num_threads, on_threads

# Sections of the items for each thread. Neighbouring items write to the same cache lines: threads that took items in
# turns would pass these lines to and fro.
_SECTIONS = 4
_LINE = 64  # bytes; the counter of each section has a cache line of its own

P = ParamSpec("P")


class Worker(Generic[P]):
    """A kernel made of C++; call it with the arguments of its stub to run it on every thread. See `worker`.

    A call checks the names of the arguments, and type, layout, dtype and device of each field; what Warp and the kernel
    get are bare addresses. Sizes are checked where `guard.py` is on.

    Raises:
        TypeError: Arguments are missing, too many, or not of the declared kind.
    """

    def __init__(
        self,
        name: str,
        stub: Callable[P, None],
        code: str,
        file: str | None,
        structs: tuple[type, ...],
        constants: dict[str, int | float],
        alone: bool,
    ) -> None:
        self.name = name
        self.file = file
        self._parameters: tuple[Parameter, ...] = parameters_of(stub)
        self.structs = tuple(dict.fromkeys((*structs_of(self._parameters), *structs)))
        self.constants = constants  # of this kernel alone
        self._fields = [field for parameter in self._parameters for field in parameter.fields]
        self._signature = inspect.signature(stub)
        self._sizes = Sizes(name, self._fields, constants)
        self._code = code
        self._alone = alone  # on this thread
        self._kernel: Kernel | None = None
        by_name = any(p.kind is p.KEYWORD_ONLY for p in self._signature.parameters.values())
        self._read = call_reader(name, self._parameters, by_name)
        self._loading = threading.Lock()

    @property
    def parameter_names(self) -> list[str]:
        """Names of the parameters, of which a struct is one."""
        return [parameter.name for parameter in self._parameters]

    def __call__(self, *args: P.args, **kwargs: P.kwargs) -> None:
        values = self._read(*args, **kwargs)
        if values is None:
            self._refuse_call(self.fields_of(*args, **kwargs))
        elif guard.level() == guard.OFF:
            self._run(values)
        else:
            self._run_checked(values, self.fields_of(*args, **kwargs))

    def fields_of(self, *args: P.args, **kwargs: P.kwargs) -> dict[str, Any]:
        """The fields of a call by their paths, in the order of the kernel's.

        Raises:
            TypeError: An argument is not the declared struct.
        """
        arguments = self._signature.bind(*args, **kwargs).arguments
        values: list[Any] = []
        for parameter in self._parameters:
            argument = arguments[parameter.name]
            if parameter.struct is not None and type(argument) is not parameter.struct:
                self._refuse(parameter.name, argument)
            values += [argument] if parameter.struct is None else argument
        return dict(zip((field.path for field in self._fields), values, strict=True))

    def _run_checked(self, values: tuple[int | float, ...], fields: dict[str, Any]) -> None:
        self._sizes.check(fields)
        if guard.level() == guard.SIZES:
            self._run(values)
            return

        def run(inside: tuple[Any, ...]) -> None:
            moved = self._read(**group(self._parameters, inside))
            assert moved is not None, "copies are of the kind of their originals"
            self._run(moved)

        guard.run_between_zones(self.name, fields, run)

    def _refuse_call(self, fields: dict[str, Any]) -> None:
        """Raise TypeError or OverflowError for the first field that is not of its kind."""
        for field, argument in zip(self._fields, fields.values(), strict=True):
            if call_reader("field", (Parameter("given", None, (field,)),), False)(argument) is None:
                if field.kind is int and type(argument) is int:
                    raise OverflowError(f"{self.name}: {field.path} = {argument} does not fit into 32 bits.")
                self._refuse(field.path, argument)

    def _refuse(self, path: str, argument: Any) -> None:
        """Raise TypeError for a parameter or a field of one."""
        structs = {parameter.name: parameter.struct for parameter in self._parameters}
        kind: Any = structs.get(path) or next(field.kind for field in self._fields if field.path == path)
        is_array = isinstance(kind, ArrayKind)
        wanted = f"contiguous tensor of {kind.dtype} on the CPU" if is_array else kind.__name__
        got = f"{type(argument).__name__} {argument!r:.40}"
        if is_array and isinstance(argument, Tensor):
            layout = "contiguous" if argument.is_contiguous() else f"strides {argument.stride()}"
            got = f"{argument.dtype} on {argument.device}, {layout}"
        raise TypeError(f"{self.name}: {path} must be a {wanted}, got {got}.") from None

    def _run(self, values: tuple[int | float, ...]) -> None:
        with LOCK:
            kernel, threads = self._kernel or self.load(), 1 if self._alone else get_num_threads()
            if threads == 1:
                on_threads(1, kernel, kernel.pack(0, *values))
                return
            sections = _SECTIONS * threads
            counters = (ctypes.c_int32 * (_LINE // 4 * (sections + 2)))()
            counters[_LINE // 4] = sections
            # The threads share the arguments of one call.
            on_threads(threads, kernel, kernel.pack(ctypes.addressof(counters) + _LINE, *values))

    def load(self) -> Kernel:
        """Compile the kernel or take it from the cache, unless that is done; any thread may, while kernels run."""
        if self._kernel is None:
            with self._loading:
                if self._kernel is None:
                    self._kernel = self._load()
        return self._kernel

    def _load(self) -> Kernel:
        parameters = {"counters_address": "wp.uint64"} | {field.symbol: field.warp for field in self._fields}
        return load_kernel(self.name, parameters, self.text)

    @property
    def text(self) -> str:
        """All of its C++."""
        declared = declare(SHARED | self.constants) + "".join(map(declare_struct, self.structs))
        functions = "" if self.file is None else read_kernel(self.file)
        definitions = "".join(parameter.definition for parameter in self._parameters)
        # A thread by itself counts on its stack.
        definitions += f"int alone_[{_LINE // 2}] = {{1}};\n"
        definitions += "int* const counters = counters_address ? (int*)counters_address : alone_;\n"
        return f"{PRELUDE}{declared}{functions}{definitions}{self._code}"


def worker(
    code: str = "",
    *,
    items: str,
    grain: str | int,
    file: str | None = None,
    structs: tuple[type, ...] = (),
    name: str | None = None,
    constants: dict[str, int | float] | None = None,
) -> Callable[[Callable[P, None]], Worker[P]]:
    """Turns a stub function into a `Worker`.

    The stub's parameters are annotated with the arrays of `parameters.py`, `int`, `float`, or a struct of these. C++
    knows them by their names, what `simd.h` defines, the constants of `constants.py` and the optimizations by name.

    Args:
        code: C++ that handles items `[first, last)`.
        items: C++ expression for the number of items, in terms of the stub's parameters.
        grain: Items taken at a time, a number or C++.
        file: In place of `code`, a file in `kernels/` that defines a function of its name. It takes the stub's
            parameters in their order, and then `first` and `last`.
        structs: More that the file's functions pass to one another.
        name: Name of the kernel where the stub's own is not unique.
        constants: More of them, of this kernel alone.
    """

    def build(stub: Callable[P, None]) -> Worker[P]:
        own = code
        if file is not None:
            own = f"{file.removesuffix('.h')}({', '.join([*inspect.signature(stub).parameters, 'first', 'last'])});"
        # A thread takes its own sections in their order, then the others' from behind, where their owner comes last.
        # Names end in an underscore so that they hide none of the stub's.
        loop = f"""const int sections_ = counters[0], thread_ = __atomic_fetch_add(counters + 1, 1, __ATOMIC_RELAXED);
const long long step_ = {grain}, steps_ = (({items}) + step_ - 1) / step_;
for (int turn_ = 0; turn_ < sections_; ++turn_) {{
    const int ahead_ = turn_ < {_SECTIONS} ? turn_ : sections_ + {_SECTIONS} - 1 - turn_;
    const int section_ = (thread_ * {_SECTIONS} + ahead_) % sections_;
    const int begin_ = (int)(steps_ * section_ / sections_), end_ = (int)(steps_ * (section_ + 1) / sections_);
    for (;;) {{
        const int at_ = begin_ + __atomic_fetch_add(counters + {_LINE // 4} * (section_ + 1), 1, __ATOMIC_RELAXED);
        if (at_ >= end_) break;
        const int first = (int)(at_ * step_), last = smaller(first + (int)step_, {items});
{own}
    }}
}}
"""
        return Worker(name or stub.__name__, stub, loop, file, structs, constants or {}, alone=items == "1")

    return build
