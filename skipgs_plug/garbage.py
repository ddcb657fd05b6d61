"""Pause the garbage collector while a program starts and ends.

Importing torch makes some hundred thousand objects, and all of them stay. Scanning them again and again took a sixth of
the start-up time, and one more scan at the end took as long. So did the first scan after a pause: 0.09 s after the
imports of `train`, and 0.05 s after the scene was loaded.
"""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator

_keeps = False  # whether the program keeps everything; a count says nothing, as Python 3.12 itself exempts objects


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Turn the collector off inside the block, in which few objects become unreachable.

    In a program that keeps everything, objects that exist when the block ends are kept, too.
    """
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if _keeps:
            keep_everything()
        if running:
            gc.enable()


def keep_everything() -> None:
    """Exempt all present objects from collection.

    For whole programs only: present cycles that become unreachable later are never freed.
    """
    global _keeps
    _keeps = True
    gc.freeze()
