"""Keep memory that a script frees for its next tensors, instead of giving it back to the system at once."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from skipgs_plug.compat.child_processes import also_in_children

# Parameters of glibc's malloc, their values inside the block, and its own initial values; see mallopt(3).
# Blocks that may be mapped for themselves: such a block goes back to the system when it is freed.
MMAP_MAX, NO_BLOCK, BLOCKS = -4, 0, 65_536
# Bytes of free memory at the end of the heap from which it goes back.
TRIM_THRESHOLD, NEVER, BYTES = -1, -1, 128 << 10


@contextmanager
def freed_memory_kept() -> Iterator[None]:
    """Let glibc keep all freed memory inside the block. Other C libraries are left alone.

    Tensors of 32 MiB and more are mapped for themselves otherwise, so that the system must fill their pages with zeros
    at each allocation. A script that joins the SH coefficients of 190,000 Gaussians in each iteration has such tensors.
    """
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None
    set_parameter = getattr(libc, "mallopt", None)
    if libc is None or set_parameter is None:
        yield
        return
    set_parameter(MMAP_MAX, NO_BLOCK)
    set_parameter(TRIM_THRESHOLD, NEVER)
    try:
        with also_in_children(freed_memory_kept):
            yield
    finally:
        set_parameter(MMAP_MAX, BLOCKS)
        set_parameter(TRIM_THRESHOLD, BYTES)
        libc.malloc_trim(0)
