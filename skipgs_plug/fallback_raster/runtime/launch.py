"""Workers: kernels that run on all cores.

Kernels are C++ (`kernels/*.h`) with Clang's vector types. Warp compiles each on first use, which takes up to a few
seconds (`native.py`). No kernel is written in Warp's Python dialect, whose scalar code is not vectorised across pixels.

Warp executes a CPU launch on the calling thread, but it releases the interpreter lock while the kernel runs. So every
kernel here is a worker: it takes a few items at a time from shared atomic counters until all are taken, and a call
starts one worker on each thread. Items are handed out dynamically, so a busy core or an expensive tile does not delay
the others. No two items write to one location, so the result does not depend on the number of threads.
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

# Contiguous sections of the items that each thread starts with. Neighbouring items write to the same cache lines, so
# threads that alternate item by item would pass these lines to and fro. Several sections let idle threads help late.
_SECTIONS_PER_THREAD = 4
# Bytes of a cache line. The counter of each section has a line of its own, so that threads do not share one.
_LINE_BYTES = 64
_LINE_INTS = _LINE_BYTES // 4

P = ParamSpec("P")


class Worker(Generic[P]):
    """A C++ kernel. Calling it with the arguments of its stub runs it on every thread. See `worker`.

    A call checks the names of the arguments, and the type, layout, dtype and device of each field. Warp and the kernel
    receive bare addresses. Sizes are checked only while `guard.py` is on.

    Raises:
        TypeError: An argument is missing, unknown, or not of the declared kind.
        OverflowError: A whole number does not fit into 32 bits.
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
        self.constants = constants  # defined for this kernel only
        self._fields = [field for parameter in self._parameters for field in parameter.fields]
        self._signature = inspect.signature(stub)
        self._sizes = Sizes(name, self._fields, constants)
        self._code = code
        self._alone = alone  # runs on the calling thread only
        self._kernel: Kernel | None = None
        by_name = any(p.kind is p.KEYWORD_ONLY for p in self._signature.parameters.values())
        self._read = call_reader(name, self._parameters, by_name)
        self._loading = threading.Lock()

    @property
    def parameter_names(self) -> list[str]:
        """Names of the parameters. A struct counts as one parameter."""
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
        """Fields of a call by path, in the order of the kernel's fields.

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
        """Raise TypeError or OverflowError for the first field that does not have the declared kind."""
        for field, argument in zip(self._fields, fields.values(), strict=True):
            if call_reader("field", (Parameter("given", None, (field,)),), False)(argument) is None:
                if field.kind is int and type(argument) is int:
                    raise OverflowError(f"{self.name}: {field.path} = {argument} does not fit into 32 bits.")
                self._refuse(field.path, argument)

    def _refuse(self, path: str, argument: Any) -> None:
        """Raise TypeError for a parameter, or for a field of a struct."""
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
            sections = _SECTIONS_PER_THREAD * threads
            # Line 0 separates the counters from other memory, line 1 is shared, and each section has one of the others.
            counters = (ctypes.c_int32 * (_LINE_INTS * (sections + 2)))()
            counters[_LINE_INTS] = sections
            # All threads share these arguments.
            on_threads(threads, kernel, kernel.pack(ctypes.addressof(counters) + _LINE_BYTES, *values))

    def load(self) -> Kernel:
        """Load the kernel from the cache, or compile it, unless it is loaded. Any thread may call this at any time."""
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
        """The whole C++ text of the kernel."""
        declared = declare(SHARED | self.constants) + "".join(map(declare_struct, self.structs))
        functions = "" if self.file is None else read_kernel(self.file)
        definitions = "".join(parameter.definition for parameter in self._parameters)
        # A single thread has one section and keeps its two lines of counters on the stack.
        definitions += f"int alone_[{2 * _LINE_INTS}] = {{1}};\n"
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
    """Turn a stub function into a `Worker`.

    The stub's parameters are annotated with the arrays of `parameters.py`, `int`, `float`, or a struct of these. C++
    code may use the parameters, the definitions of `simd.h`, the constants of `constants.py` and the bits of the
    optimizations, each by name.

    Args:
        code: C++ code that processes the items `[first, last)`.
        items: C++ expression for the number of items, in terms of the stub's parameters.
        grain: Number of items that a thread takes at a time, or a C++ expression for it.
        file: Used in place of `code`: a file in `kernels/` that defines a function of the same name. The function takes
            the stub's parameters in order, then `first` and `last`.
        structs: Further structs that functions of the file pass to each other.
        name: Name of the kernel, if the name of the stub is not unique.
        constants: Further C++ constants, defined for this kernel only.

    Returns:
        A decorator for the stub.
    """

    def build(stub: Callable[P, None]) -> Worker[P]:
        own = code
        if file is not None:
            own = f"{file.removesuffix('.h')}({', '.join([*inspect.signature(stub).parameters, 'first', 'last'])});"
        # A thread works through its own sections in order, then through those of others from the last to the first,
        # because their owner reaches the last one last. Names end in an underscore to stay apart from the stub's.
        mine = _SECTIONS_PER_THREAD
        loop = f"""const int sections_ = counters[0], thread_ = __atomic_fetch_add(counters + 1, 1, __ATOMIC_RELAXED);
const long long step_ = {grain}, steps_ = (({items}) + step_ - 1) / step_;
for (int round_ = 0; round_ < sections_; ++round_) {{
    const int ahead_ = round_ < {mine} ? round_ : sections_ + {mine} - 1 - round_;
    const int section_ = (thread_ * {mine} + ahead_) % sections_;
    const int begin_ = (int)(steps_ * section_ / sections_), end_ = (int)(steps_ * (section_ + 1) / sections_);
    for (;;) {{
        const int at_ = begin_ + __atomic_fetch_add(counters + {_LINE_INTS} * (section_ + 1), 1, __ATOMIC_RELAXED);
        if (at_ >= end_) break;
        const int first = (int)(at_ * step_), last = smaller(first + (int)step_, {items});
{own}
    }}
}}
"""
        return Worker(name or stub.__name__, stub, loop, file, structs, constants or {}, alone=items == "1")

    return build
