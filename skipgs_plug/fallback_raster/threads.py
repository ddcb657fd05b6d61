"""The threads that kernels run on, beside the one that calls.

One launch takes place at a time, under `LOCK`. Between kernels threads wait in Python; while they run one they hold no
interpreter lock.

KeyboardInterrupt and what signal handlers raise may come between any two steps of the main thread. Only locks and
queues that are written in C are used here: such an exception leaves a `threading.Condition`, and with it an Event, a
Future or the start of a Thread, in a state in which it raises something else or waits for ever.
"""

import _thread
import atexit
import os
import threading
import time
import warnings
from collections.abc import Callable
from queue import Empty, SimpleQueue

import torch

from .cores import usable_cores

LOCK = threading.RLock()
_num_threads = usable_cores()
_crew: "_Crew | None" = None
_busy = False  # threads of the crew may still be at work
_forked = False  # this process inherited torch's OpenMP without its threads, and has not been told so


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
    global _num_threads
    if not isinstance(n, int) or n < 1:
        raise ValueError(f"set_num_threads expects a whole number of at least 1, got {n!r}.")
    with LOCK:
        _num_threads = n
        _dismiss()


def on_all_threads(work: Callable[[], None]) -> None:
    """Runs `work` on every thread and returns when all are done, also when an exception arrives meanwhile.

    Another exception may come while the threads are awaited. So they count as busy until all are known to be done, and
    the next call waits for that. The caller holds `LOCK`.
    """
    global _crew, _busy
    if _forked:
        _warn_after_fork()
    if _num_threads == 1:
        work()
        return
    if _busy:
        _dismiss()
    if _crew is None:
        _crew = _Crew(_num_threads - 1)
    _busy = True
    _crew.run(work)
    _busy = False


class _Crew:
    """Threads that wait for work."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
        self._done: SimpleQueue[BaseException | None] = SimpleQueue()
        self._alive = list(range(count))
        for number in range(count):
            _thread.start_new_thread(self._serve, (number,))

    def run(self, work: Callable[[], None]) -> None:
        """Do it on all of them and here."""
        given, failure = 0, None
        try:
            for _ in range(self._count):
                self._work.put(work)
                given += 1
            work()
        finally:
            for _ in range(given):
                try:
                    self._work.get_nowait()  # a thread that has not begun by now would find no item left
                except Empty:
                    failure = self._done.get() or failure
        if failure is not None:
            raise failure

    def dismiss(self) -> None:
        """Wait until all are done and gone; may be called again when an exception ended it."""
        for _ in range(self._count):
            self._work.put(None)
        while self._alive:
            time.sleep(0.0005)

    def _serve(self, number: int) -> None:
        try:
            while (work := self._work.get()) is not None:
                failure = None
                try:
                    work()
                except BaseException as error:
                    failure = error
                del work  # it holds tensors
                self._done.put(failure)
        finally:
            self._alive.remove(number)


@atexit.register
def _dismiss() -> None:
    """No thread runs a kernel when this returns."""
    global _crew, _busy
    if _crew is not None:
        _crew.dismiss()
    _crew, _busy = None, False


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
    """Threads do not survive a fork: a child starts its own."""
    global _crew, _busy, _forked
    _crew, _busy = None, False
    _forked = torch.get_num_threads() > 1
    LOCK.release()


# A child must not inherit the lock from a thread that renders; so a fork waits until it has finished.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=_after_fork_in_child)
