"""Helper threads that run kernels together with the calling thread, without the interpreter lock.

A helper spends its life in one call of native code (`kernels/pool_serve.h`). After a launch it spins for some
microseconds in case another follows, and then sleeps until it is woken. If helpers were ordinary Python threads, they
and the caller would need the interpreter lock at the same moments, and every launch would wait several times for the
system to wake a thread.
"""

import _thread
import ctypes
import threading
import time

from .cores import usable_cores
from .native import Kernel, load_kernel
from .source import PRELUDE, read_kernel

# Times that a thread checks for a launch before it sleeps: 100 to 200 us on x86. More spins take processor time from
# other programs, fewer delay launches.
_MAX_SPINS = 5000

# Bytes of a cache line. Each thread has a line of its own in `kernels/lib/thread_pool.h`: threads that write to a
# shared line would pass it to and fro.
_LINE_BYTES = 64
_CALLER_LINE, _FIRST_HELPER_LINE = 2, 3  # index of the caller's line, and of the first helper's
# Bytes from the start of a thread's line to its lock, as in the struct of `kernels/lib/thread_pool.h`.
_LOCK_OFFSET = 8

# CPython's locks work on every system, and without the interpreter lock.
_allocate = ctypes.PYFUNCTYPE(ctypes.c_void_p)(("PyThread_allocate_lock", ctypes.pythonapi))
_acquire = ctypes.PYFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_int)(("PyThread_acquire_lock", ctypes.pythonapi))
_release = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("PyThread_release_lock", ctypes.pythonapi))
_free = ctypes.PYFUNCTYPE(None, ctypes.c_void_p)(("PyThread_free_lock", ctypes.pythonapi))

_loading = threading.Lock()
_kernels: tuple[Kernel, Kernel] | None = None


class ThreadPool:
    """Helpers that run kernels together with the thread that calls `run`. Only one thread may call at a time.

    Args:
        count: Number of helpers.
    """

    def __init__(self, count: int) -> None:
        self._count = count
        # With more threads than cores, a spinning thread would keep another from its work.
        self._max_spins = _MAX_SPINS if count < usable_cores() else 0
        self._server, self._launcher = load_pool_kernels()
        self._memory = (ctypes.c_char * (_LINE_BYTES * (_FIRST_HELPER_LINE + count + 1)))()
        self._address = -(-ctypes.addressof(self._memory) // _LINE_BYTES) * _LINE_BYTES
        self._locks = [self._put_lock(line) for line in range(_CALLER_LINE, _FIRST_HELPER_LINE + count)]
        self._alive = list(range(count))
        for number in range(count):
            _thread.start_new_thread(self._serve, (number,))

    def run(self, kernel: Kernel, arguments: bytes) -> None:
        """Run a kernel on all helpers and on the calling thread, and wait until all have finished."""
        held = (ctypes.c_char * len(arguments)).from_buffer_copy(arguments)
        self._launch(*kernel.addresses, ctypes.addressof(held))

    def dismiss(self) -> None:
        """Stop all helpers and wait for them. If an exception interrupts this, it may be called again."""
        self._launch(0, 0, 0)
        while self._alive:
            time.sleep(0.0005)
        while self._locks:
            _free(self._locks.pop())

    def _put_lock(self, line: int) -> int:
        """Write a new lock, already held, and its functions into a cache line. Returns the lock's address."""
        lock: int = _allocate()
        _acquire(lock, 1)
        functions = (ctypes.cast(function, ctypes.c_void_p).value for function in (_acquire, _release))
        written = (ctypes.c_void_p * 3).from_address(self._address + _LINE_BYTES * line + _LOCK_OFFSET)
        written[:] = [lock, *functions]
        return lock

    def _launch(self, *addresses: int) -> None:
        self._launcher(self._launcher.pack(self._address, *addresses, self._count, self._max_spins))

    def _serve(self, number: int) -> None:
        try:
            self._server(self._server.pack(self._address, number, self._max_spins))
        finally:
            self._alive.remove(number)


def load_pool_kernels() -> tuple[Kernel, Kernel]:
    """Load the kernels `pool_serve` and `pool_run`, once. Any thread may call this."""
    global _kernels
    with _loading:
        if _kernels is None:
            pool = {"pool": "*(ThreadPool*)"}
            launch = pool | {"function": "(void (*)(void*, void*))", "bounds": "(void*)", "arguments": "(void*)"}
            _kernels = (
                _load("pool_serve", pool, ["number", "max_spins"]),
                _load("pool_run", launch, ["helpers", "max_spins"]),
            )
        return _kernels


def _load(name: str, pointers: dict[str, str], numbers: list[str]) -> Kernel:
    """Load a kernel whose parameters are pointers, each given with the C++ cast from its address, and ints."""
    parameters = dict.fromkeys((f"{pointer}_address" for pointer in pointers), "wp.uint64")
    given = [f"{cast}{pointer}_address" for pointer, cast in pointers.items()]
    call = f"{name}({', '.join([*given, *numbers])});\n"
    text = PRELUDE + read_kernel(f"{name}.h") + call
    return load_kernel(name, parameters | dict.fromkeys(numbers, "wp.int32"), text)
