"""The number of threads that kernels run on, and the lock that lets one launch run at a time.

Launches run one at a time, under `LOCK`. A KeyboardInterrupt or an exception of a signal handler may be raised between
any two steps of the main thread, but not while a kernel runs: that is one call of native code on all threads.
"""

import atexit
import os
import threading
import warnings

import torch

from .cores import usable_cores
from .native import Kernel
from .thread_pool import ThreadPool

LOCK = threading.RLock()
_num_threads = usable_cores()
_pool: ThreadPool | None = None
_forked = False  # this process is a fork of one in which torch had several threads, and has not warned about it yet


def get_num_threads() -> int:
    """Return the number of threads of the CPU rasterizer. By default it is the number of cores this process may use."""
    return _num_threads


def set_num_threads(n: int) -> None:
    """Set the number of threads of the CPU rasterizer. Images and gradients are bit-equal for every number.

    Args:
        n: Number of threads, at least 1.

    Raises:
        ValueError: `n` is not a whole number of at least 1.

    Example:
        >>> before = get_num_threads()
        >>> set_num_threads(1)
        >>> get_num_threads()
        1
        >>> set_num_threads(before)
    """
    global _num_threads
    if not isinstance(n, int) or n < 1:
        raise ValueError(f"set_num_threads expects a whole number of at least 1, got {n!r}.")
    with LOCK:
        _num_threads = n
        _dismiss()


def on_threads(count: int, kernel: Kernel, arguments: bytes) -> None:
    """Run a kernel on the calling thread if `count` is 1, else on all, and wait for it. The caller holds `LOCK`."""
    global _pool
    if _forked:
        _warn_after_fork()
    if count == 1:
        kernel(arguments)
        return
    if _pool is None:
        _pool = ThreadPool(_num_threads - 1)
    _pool.run(kernel, arguments)


@atexit.register
def _dismiss() -> None:
    """Stop the helper threads. When this returns, no thread runs a kernel."""
    global _pool
    with LOCK:
        if _pool is not None:
            _pool.dismiss()
        _pool = None


def _warn_after_fork() -> None:
    global _forked
    _forked = False
    warnings.warn(
        "This process was forked from one in which torch had several threads, which do not survive a fork: torch "
        'may hang here. Start processes with multiprocessing\'s "spawn", or call torch.set_num_threads(1) first.',
        RuntimeWarning,
        stacklevel=5,
    )


def _after_fork_in_child() -> None:
    """Forget the helper threads, which do not survive a fork. The child starts its own."""
    global _pool, _forked
    _pool = None
    _forked = torch.get_num_threads() > 1
    LOCK.release()


# A child must not inherit a lock that another thread holds, so a fork waits until the running launch is finished.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=_after_fork_in_child)
