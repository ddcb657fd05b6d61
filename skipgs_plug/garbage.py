"""Pause the garbage collector while a program starts and ends.

Importing torch makes some hundred thousand objects, and all of them stay. Scanning them again and again took a sixth of
the start-up time, and one more scan at the end took as long.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Turn the collector off inside the block, in which few objects become unreachable."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def keep_everything() -> None:
    """Exempt all present objects from collection.

    For whole programs only: present cycles that become unreachable later are never freed.
    """
    gc.freeze()
