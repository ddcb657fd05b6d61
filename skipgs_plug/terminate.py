"""SIGTERM ends a command like Ctrl-C does, so that it can clean up."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

UNREAD = 141  # exit code when the reader of the output has gone away: 128 + SIGPIPE, as in a shell


class Terminated(KeyboardInterrupt):
    """SIGTERM arrived."""


def raise_terminated(number: int, frame: Any) -> None:
    """Be the handler; a second SIGTERM ends the process at once."""
    signal.signal(number, signal.SIG_DFL)
    raise Terminated


@contextlib.contextmanager
def terminable() -> Iterator[None]:
    """Raise `Terminated` inside the block when SIGTERM arrives; the handler of before is put back afterwards."""
    try:
        previous = signal.signal(signal.SIGTERM, raise_terminated)
    except ValueError:  # not in the main thread: whoever owns that handles signals
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
