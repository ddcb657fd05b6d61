"""Threads that run kernels beside the one that calls, without the interpreter.

A helper spends its life in one call of native code (`kernels/pool_serve.h`). Between two kernels it looks for the next
one for some microseconds, and then sleeps until it is called. As threads of Python, helpers and caller wanted the
interpreter at the same moments, and every launch waited several times for the system to wake somebody.
"""

import _thread
import ctypes
import threading
import time

from .cores import usable_cores
from .native import Kernel, load_kernel
from .source import PRELUDE, read_kernel

# How often a thread looks for what it waits for before it sleeps: for 100 to 200 microseconds on x86. Looking longer
# takes processor time from others, looking less makes launches late.
_PATIENCE = 5000

# Bytes of a cache line, of which `kernels/lib/thread_pool.h` gives each thread its own: threads that wrote into one
# line would pass it to and fro.
_LINE = 64
_CALLER, _HELPERS = 2, 3  # which of them are the caller's and the first helper's
# Bytes from the beginning of a thread's line to its lock, as in the struct of `kernels/lib/thread_pool.h`.
_LOCK = 8

# Locks of Python work on every system, and without the interpreter.
_allocate = ctypes.PYFUNCTYPE(ctypes.c_void_p)(("PyThread_allocate_lock", ctypes.pythonapi))
_acquire = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(("PyThread_acquire_lock", ctypes.pythonapi))
_release = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("PyThread_release_lock", ctypes.pythonapi))
_free = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("PyThread_free_lock", ctypes.pythonapi))

_loading = threading.Lock()
_kernels: tuple[Kernel, Kernel] | None = None


class ThreadPool:
    """Helpers that run kernels along with the thread that calls `run`, of which there is one at a time.

    Args:
        count: Number of helpers.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        # With more threads than cores, one that looks keeps another from its work.
        self._patience = _PATIENCE if count < usable_cores() else 0
        self._server, self._launcher = load_pool_kernels()
        self._memory = (ctypes.c_char * (_LINE * (_HELPERS + count + 1)))()
        self._address = -(-ctypes.addressof(self._memory) // _LINE) * _LINE
        self._locks = [self._put_lock(line) for line in range(_CALLER, _HELPERS + count)]
        self._alive = list(range(count))
        for number in range(count):
            _thread.start_new_thread(self._serve, (number,))

    def run(self, kernel: Kernel, arguments: bytes) -> None:
        """Run it on all of them and here; none of them is at it any more when this returns."""
        held = (ctypes.c_char * len(arguments)).from_buffer_copy(arguments)
        self._launch(*kernel.addresses, ctypes.addressof(held))

    def dismiss(self) -> None:
        """Wait until all are gone; may be called again when an exception ended it."""
        self._launch(0, 0, 0)
        while self._alive:
            time.sleep(0.0005)
        while self._locks:
            _free(self._locks.pop())

    def _put_lock(self, line: int) -> int:
        """A lock that is held, and the functions to use it, written into a line."""
        lock: int = _allocate()
        _acquire(lock, 1)
        functions = (ctypes.cast(function, ctypes.c_void_p).value for function in (_acquire, _release))
        written = (ctypes.c_void_p * 3).from_address(self._address + _LINE * line + _LOCK)
        written[:] = [lock, *functions]
        return lock

    def _launch(self, *addresses: int) -> None:
        self._launcher(self._launcher.pack(self._address, *addresses, self._count, self._patience))

    def _serve(self, number: int) -> None:
        try:
            self._server(self._server.pack(self._address, number, self._patience))
        finally:
            self._alive.remove(number)


def load_pool_kernels() -> tuple[Kernel, Kernel]:
    """Load the kernels of helpers and of launches, unless that is done; any thread may."""
    global _kernels
    with _loading:
        if _kernels is None:
            pool = {"pool": "*(ThreadPool*)"}
            launch = pool | {"function": "(void (*)(void*, void*))", "bounds": "(void*)", "arguments": "(void*)"}
            _kernels = (
                _load("pool_serve", pool, ["number", "patience"]),
                _load("pool_run", launch, ["helpers", "patience"]),
            )
        return _kernels


def _load(name: str, pointers: dict[str, str], numbers: list[str]) -> Kernel:
    """The kernel of a name, which takes pointers, each with the C++ cast that makes it of an address, and ints."""
    parameters = dict.fromkeys((f"{pointer}_address" for pointer in pointers), "wp.uint64")
    given = [f"{cast}{pointer}_address" for pointer, cast in pointers.items()]
    call = f"{name}({', '.join([*given, *numbers])});\n"
    text = PRELUDE + read_kernel(f"{name}.h") + call
    return load_kernel(name, parameters | dict.fromkeys(numbers, "wp.int32"), text)
