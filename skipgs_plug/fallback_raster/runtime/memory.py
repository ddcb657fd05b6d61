"""Memory of large tensors, used again by the next one of about that size.

Allocators give pieces beyond some size (32 MiB at most in glibc) back to the system at once, and the system fills
every page that it hands out with zeros, at a fault each: for the gradients of 1,000,000 Gaussians that took longer than
Adam. Here the pages stay mapped. A piece is free when the last tensor that lies in it is gone, whoever held it. It is a
little longer than asked for, since densification makes each tensor a little longer than the one before, and of large
pages, whose addresses a processor finds sooner.
"""

import math
import mmap
import weakref
from collections import deque

import torch
from torch import Tensor

# Bytes from which a tensor gets a piece of memory that stays mapped. Keeping smaller ones too (from 1, 2 or 4 MiB)
# gained nothing, and takes 10 us in Python for each tensor.
LARGE = 1 << 23
# A piece has room for a tensor larger by 1 / GROWTH, so that it fits after densification, too. Pages without content
# take no memory.
GROWTH = 8
# A tensor takes a free piece if the piece is larger by 1 / SLACK of the tensor at most: a fifth of the piece is unused
# then.
SLACK = 4
# Free pieces that fit nothing for a while may take an eighth of what was ever in use. Without it those that only the
# forward pass needs push out the gradients, which are mapped and filled with zeros anew in every iteration.
SPARE = 8

# Windows has no private pages without a file.
SUPPORTED = hasattr(mmap, "MAP_PRIVATE")


class Pool:
    """Pieces of memory: those in use, and free ones, of both an eighth more bytes at most than were in use at one time.

    Attributes:
        mapped: bytes of all pieces.
    """

    def __init__(self) -> None:
        self.mapped = self._used = self._most = 0
        self._free: list[mmap.mmap] = []  # the one that became free last comes last
        # Tensors die in any thread at any moment, also while this one is in here.
        self._returned: deque[mmap.mmap] = deque()
        self._held: dict[int, weakref.ref[memoryview]] = {}

    def empty(self, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """A tensor with undefined content; one caller at a time."""
        size: int = math.prod(shape) * dtype.itemsize
        self._collect()
        piece = self._take(size) or self._map(size)
        self._used += len(piece)
        self._most = max(self._most, self._used)
        # A tensor holds the view, and one that dies says so.
        view = memoryview(piece)
        key, returned, held = id(view), self._returned, self._held

        def free(_: object) -> None:
            del held[key]
            returned.append(piece)

        held[key] = weakref.ref(view, free)
        storage = torch.frombuffer(view, dtype=torch.uint8).untyped_storage()
        # Not a view of the buffer: those of a custom Function must not be changed in place.
        return torch.empty(0, dtype=dtype, device="cpu").set_(storage, 0, shape)  # type: ignore[call-overload]

    def release(self) -> None:
        """Give the free pieces back to the system, and forget how much was ever in use."""
        self._collect()
        self._drop(0)
        self._most = self._used

    def _collect(self) -> None:
        while self._returned:
            piece = self._returned.popleft()
            self._used -= len(piece)
            self._free.append(piece)

    def _take(self, size: int) -> mmap.mmap | None:
        """The smallest free piece that fits closely."""
        fitting = [piece for piece in self._free if size <= len(piece) <= size + size // SLACK + mmap.PAGESIZE]
        if not fitting:
            return None
        piece = min(fitting, key=len)
        self._free.remove(piece)
        return piece

    def _map(self, size: int) -> mmap.mmap:
        size += size // GROWTH
        size = -(-size // mmap.PAGESIZE) * mmap.PAGESIZE
        self._drop(max(self._most + self._most // SPARE - self._used - size, 0))
        piece = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        if hasattr(mmap, "MADV_HUGEPAGE"):
            piece.madvise(mmap.MADV_HUGEPAGE)
        self.mapped += size
        return piece

    def _drop(self, room: int) -> None:
        """Unmap the pieces that have been free for longest until no more than `room` bytes are free."""
        free = sum(map(len, self._free))
        while free > room:
            piece = self._free.pop(0)
            free -= len(piece)
            self.mapped -= len(piece)
            piece.close()
