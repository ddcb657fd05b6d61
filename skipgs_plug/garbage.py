"""The collector of unreachable objects rests while a program starts and ends.

Importing torch makes some hundred thousand objects, all of which stay. To look through them again and again took a
sixth of the time of starting, and to look through them once more at the end as much.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Let nothing be collected inside the block, where hardly anything becomes unreachable."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def keep_everything() -> None:
    """Take all objects of now for such that stay until the process ends, so that the collector passes them over.

    For whole programs only: cycles of now that become unreachable later are never freed.
    """
    gc.freeze()
