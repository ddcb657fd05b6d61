"""Peak memory of a part of a run: PyTorch's memory on the GPU, memory of the whole process on the CPU."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path
from typing import Protocol

import torch

from skipgs_plug.fallback_raster import release_memory

STATUS, CLEAR = Path("/proc/self/status"), Path("/proc/self/clear_refs")
RESET_PEAK = "5"  # resets VmHWM, see proc(5)


class MemoryMeter(Protocol):
    """Measures the peak of memory since the last reset."""

    def reset(self) -> int:
        """Forget the peak so far, and return the bytes in use."""
        ...

    def peak(self) -> int:
        """Return the largest number of bytes in use since the last reset."""
        ...


class CudaMeter:
    """Measures the bytes that PyTorch has allocated on a GPU."""

    def __init__(self, device: torch.device) -> None:
        self._device = device

    def reset(self) -> int:
        torch.cuda.reset_peak_memory_stats(self._device)
        return torch.cuda.memory_allocated(self._device)

    def peak(self) -> int:
        return torch.cuda.max_memory_allocated(self._device)


class ProcessMeter:
    """Measures the resident bytes of this process on Linux.

    A reset returns freed memory to the system. Otherwise a run would reuse the memory of another run and seem smaller.
    """

    def __init__(self) -> None:
        self._trim = getattr(ctypes.CDLL(None), "malloc_trim", None)  # a function of glibc

    def reset(self) -> int:
        release_memory()
        if self._trim is not None:
            self._trim(0)
        CLEAR.write_text(RESET_PEAK)
        return _status("VmRSS")

    def peak(self) -> int:
        return _status("VmHWM")


def memory_meter(device: torch.device) -> MemoryMeter | None:
    """Return the meter for this device; None if this system does not report memory."""
    if device.type == "cuda":
        return CudaMeter(device)
    if not CLEAR.exists():
        return None
    meter = ProcessMeter()
    try:
        meter.reset()
        meter.peak()
    except OSError:
        return None
    return meter


def _status(name: str) -> int:
    """Return the value of a line of /proc/self/status in bytes."""
    found = re.search(rf"^{name}:\s*(\d+) kB$", STATUS.read_text(), re.MULTILINE)
    if found is None:
        raise OSError(f"{STATUS} has no line {name}")
    return 1024 * int(found[1])
