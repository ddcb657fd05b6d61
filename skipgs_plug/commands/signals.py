"""Ctrl-C and SIGTERM while training: stop between two iterations, so that the checkpoint is exact."""

from __future__ import annotations

import contextlib
import signal
from collections.abc import Iterator
from typing import Any

from skipgs_plug.trainer import Trainer

STOPPING = (signal.SIGINT, signal.SIGTERM)


class Stop:
    """The signal that arrived.

    Attributes:
        exit_code: 0, or 128 + number of the signal, as a shell reports it.
    """

    def __init__(self) -> None:
        self.exit_code = 0


@contextlib.contextmanager
def stop_on_signal(trainer: Trainer) -> Iterator[Stop]:
    """Let a signal end training after the current iteration. A second signal raises KeyboardInterrupt at once."""
    stop = Stop()

    def handle(number: int, frame: Any) -> None:
        if stop.exit_code:
            raise KeyboardInterrupt
        stop.exit_code = 128 + number
        trainer.stop_requested = True

    previous: dict[signal.Signals, Any] = {}
    try:
        # ValueError: not in the main thread, whose owner handles signals.
        with contextlib.suppress(ValueError):
            for signum in STOPPING:
                previous[signum] = signal.signal(signum, handle)
        yield stop
    finally:
        for signum, handler in previous.items():
            signal.signal(signum, handler)
