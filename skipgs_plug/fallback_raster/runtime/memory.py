"""Memory of large tensors, which later tensors of about the same size reuse.

Allocators return pieces above some size to the system at once (32 MiB at most in glibc), and the system fills every
page that it hands out with zeros, at one page fault each. For the gradients of 1,000,000 Gaussians that took longer
than Adam. Here the pages stay mapped. A piece becomes free when the last tensor in it is gone. A piece is slightly
longer than requested, because densification makes each tensor slightly longer than the one before. Pieces use huge
pages, whose addresses a processor translates faster.
"""

import math
import mmap
import weakref
from collections import deque

import torch
from torch import Tensor

# Tensors of at least this many bytes (8 MiB) get a piece that stays mapped. Starting at 1, 2 or 4 MiB gained nothing,
# and a piece takes 10 us of Python for each tensor.
POOLED_BYTES = 1 << 23
# A new piece has room for a tensor that is larger by 1 / GROWTH_DIVISOR, so that it still fits after a densification.
# Pages that were never written take no memory.
GROWTH_DIVISOR = 8
# A tensor takes a free piece that is larger than itself by at most 1 / SLACK_DIVISOR. Then at most a fifth of the piece
# is unused.
SLACK_DIVISOR = 4
# Used and free pieces together may exceed the largest number of bytes ever in use by 1 / SPARE_DIVISOR. Without this
# allowance, pieces that only the forward pass needs push out those of the gradients, which are then mapped and filled
# with zeros again in every iteration.
SPARE_DIVISOR = 8

# Windows has no anonymous private mappings.
SUPPORTED = hasattr(mmap, "MAP_PRIVATE")


class Pool:
    """Pieces of memory, in use and free. All together exceed the most bytes ever in use by at most an eighth.

    Attributes:
        mapped: Bytes of all pieces.
    """

    def __init__(self) -> None:
        self.mapped = self._used = self._most = 0
        self._free: list[mmap.mmap] = []  # ordered by the time when they became free
        # Tensors die in any thread at any moment, also while this thread is inside a method.
        self._returned: deque[mmap.mmap] = deque()
        self._held: dict[int, weakref.ref[memoryview]] = {}

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """Return a tensor with undefined content. Callers must take turns."""
        size: int = math.prod(shape) * dtype.itemsize
        self._collect()
        piece = self._take(size) or self._map(size)
        self._used += len(piece)
        self._most = max(self._most, self._used)
        # The tensor holds the view. When the view dies, `free` is called.
        view = memoryview(piece)
        key, returned, held = id(view), self._returned, self._held

        def free(_: object) -> None:
            del held[key]
            returned.append(piece)

        held[key] = weakref.ref(view, free)
        storage = torch.frombuffer(view, dtype=torch.uint8).untyped_storage()
        # Not a view of the buffer: views returned by a custom autograd Function must not be changed in place.
        return torch.empty(0, dtype=dtype, device="cpu").set_(storage, 0, shape)  # type: ignore[call-overload]

    def release(self) -> None:
        """Return all free pieces to the system, and reset the record of the most bytes in use."""
        self._collect()
        self._drop(0)
        self._most = self._used

    def _collect(self) -> None:
        while self._returned:
            piece = self._returned.popleft()
            self._used -= len(piece)
            self._free.append(piece)

    def _take(self, size: int) -> mmap.mmap | None:
        """Take the smallest free piece that fits closely, or return None."""
        fitting = [piece for piece in self._free if size <= len(piece) <= size + size // SLACK_DIVISOR + mmap.PAGESIZE]
        if not fitting:
            return None
        piece = min(fitting, key=len)
        self._free.remove(piece)
        return piece

    def _map(self, size: int) -> mmap.mmap:
        size += size // GROWTH_DIVISOR
        size = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
        self._drop(max(self._most + self._most // SPARE_DIVISOR - self._used - size, 0))
        piece = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if hasattr(mmap, "MADV_HUGEPAGE"):
            piece.madvise(mmap.MADV_HUGEPAGE)
        self.mapped += size
        return piece

    def _drop(self, room: int) -> None:
        """Unmap pieces, longest free first, until at most `room` bytes are free."""
        free = sum(map(len, self._free))
        while free > room:
            piece = self._free.pop(0)
            free -= len(piece)
            self.mapped -= len(piece)
            piece.close()
