"""Make the threads that a script starts enter context managers that hold for one thread only."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from skipgs_plug.compat.stand_ins import stand_ins


@contextmanager
def also_in_threads(enter: Callable[[], AbstractContextManager[None]]) -> Iterator[None]:
    """Let each `threading.Thread` that is started inside the `with` statement run inside `enter()`.

    Threads that are not Python's, such as those of torch's autograd, are left alone.
    """
    start = threading.Thread.start

    @functools.wraps(start)
    def start_inside(thread: threading.Thread) -> None:
        run = thread.run

        def run_inside() -> None:
            del vars(thread)["run"]  # it refers to the thread, which would wait for the garbage collector
            with enter():
                run()

        vars(thread)["run"] = run_inside
        start(thread)

    with stand_ins([(threading.Thread, "start", start_inside)]):
        yield
