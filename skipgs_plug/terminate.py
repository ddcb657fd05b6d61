"""Let SIGTERM end a command like Ctrl-C, so that the command can clean up."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

UNREAD = 141  # exit code when the reader of the output is gone: 128 + SIGPIPE, like a shell


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


def raise_terminated(number: int, frame: Any) -> None:
    """Handle SIGTERM. A second SIGTERM ends the process at once."""
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` inside the block when SIGTERM arrives. The previous handler is restored afterwards."""
    try:
        previous = signal.signal(signal.SIGTERM, raise_terminated)
    except ValueError:  # not in the main thread, whose owner handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
