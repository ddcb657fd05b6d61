"""A number that is copied from the device to the host. The host waits only when it needs the value."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


class HostCopy:
    """Begins to copy a tensor of one value to the host, behind the work that the device was given so far.

    `value` waits for the copy alone, and not for what was launched after it: a backward, say. On the CPU, and on
    devices without events, nothing is begun and `value` reads the tensor.

    Args:
        tensor: One value, of any shape.
    """

    __slots__ = ("_copy", "_event", "_value")

    def __init__(self, tensor: Tensor) -> None:
        self._event: Any = None
        self._value: float | None = None
        self._copy = tensor.detach()
        if has_events(tensor.device):
            # PyTorch makes a copy that does not block in pinned memory.
            self._copy = self._copy.to("cpu", non_blocking=True)
            self._event = getattr(torch, tensor.device.type).Event()
            self._event.record()

    @property
    def is_under_way(self) -> bool:
        """Whether asking for the value would wait for a copy."""
        return self._event is not None

    def value(self) -> float:
        """Return the value; wait until it has arrived."""
        if self._value is None:
            if self._event is not None:
                self._event.synchronize()
                self._event = None
            self._value = self._copy.item()
        return self._value


@functools.cache
def has_events(device: torch.device) -> bool:
    """Whether copies from this device can be waited for one by one."""
    # On MPS a copy that does not block is not in order with events.
    return device.type not in ("cpu", "mps") and hasattr(getattr(torch, device.type, None), "Event")
