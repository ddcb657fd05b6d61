"""Measurements of a device: synchronization, peak memory, and how often the host waits."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

import torch


class Machine(Protocol):
    """A device that can be measured."""

    name: str

    def synchronize(self) -> None: ...

    def reset_peak(self) -> None: ...

    def peak_bytes(self) -> int: ...

    def waits(self) -> Iterator[list[int]]: ...


class CudaMachine:
    """The current CUDA device."""

    def __init__(self) -> None:
        self.name = torch.cuda.get_device_name()

    def synchronize(self) -> None:
        torch.cuda.synchronize()

    def reset_peak(self) -> None:
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()

    def peak_bytes(self) -> int:
        torch.cuda.synchronize()
        return torch.cuda.max_memory_allocated()

    @contextmanager
    def waits(self) -> Iterator[list[int]]:
        """Count synchronizing operations inside the `with` statement, exactly, because PyTorch warns of each."""
        count = [0]
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            torch.cuda.set_sync_debug_mode("warn")
            try:
                yield count
            finally:
                torch.cuda.set_sync_debug_mode("default")
        count[0] = sum("synchroniz" in str(one.message) for one in caught)
