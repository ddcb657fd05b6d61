"""Let SIGTERM end a command like Ctrl-C, so that the command can clean up."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

AGAIN = 0.01  # seconds after which an error that Python dropped is raised again
UNREAD = 141  # exit code when the reader of the output is gone: 128 + SIGPIPE, like a shell


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


def raise_terminated(number: int, frame: Any) -> None:
    """Handle SIGTERM. A second SIGTERM ends the process at once."""
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


def raised_again(report: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return a hook for errors that Python drops, which raises `Terminated` again and passes the others to `report`.

    Python drops errors inside finalizers and callbacks of weak references. SIGTERM may arrive while one runs.
    """

    def hook(dropped: Any) -> None:
        if dropped.exc_type is not Terminated:
            report(dropped)
            return
        signal.signal(signal.SIGTERM, raise_terminated)
        threading.Timer(AGAIN, signal.raise_signal, [signal.SIGTERM]).start()  # when the finalizer is over

    return hook


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` inside the block when SIGTERM arrives. The previous handlers are restored afterwards."""
    try:
        previous = signal.signal(signal.SIGTERM, raise_terminated)
    except ValueError:  # not in the main thread, whose owner handles signals
        yield
        return
    report = sys.unraisablehook
    sys.unraisablehook = raised_again(report)
    try:
        yield
    finally:
        sys.unraisablehook = report
        signal.signal(signal.SIGTERM, previous)
