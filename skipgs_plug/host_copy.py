"""A number that is copied from the device to the host. The host waits only when it needs the value."""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor


class HostCopy:
    """Starts a copy of a tensor with one value to the host, behind the work that is queued on the device so far.

    `value` waits for the copy only, and not for work that is queued later, such as a backward pass. On the CPU, and on
    devices that cannot copy beside other work, no copy is started and `value` reads the tensor.

    Args:
        tensor: One value, of any shape.
    """

    __slots__ = ("_copy", "_event", "_value")

    def __init__(self, tensor: Tensor) -> None:
        self._event: Any = None
        self._value: float | None = None
        self._copy = tensor.detach()
        if copies_in_background(tensor.device):
            # PyTorch puts a non-blocking copy in pinned memory.
            self._copy = self._copy.to("cpu", non_blocking=True)
            self._event = getattr(torch, tensor.device.type).Event()
            self._event.record()

    @property
    def is_under_way(self) -> bool:
        """Whether `value` may have to wait for the copy."""
        return self._event is not None

    def value(self) -> float:
        """Return the value; wait until it has arrived."""
        if self._value is None:
            if self._event is not None:
                self._event.synchronize()
                self._event = None
            self._value = self._copy.item()
        return self._value


def on_host(number: float | Tensor | HostCopy) -> float:
    """Return the value of a number; this waits for the device that holds it."""
    if isinstance(number, Tensor):
        return float(number.item())
    return number.value() if isinstance(number, HostCopy) else float(number)


@functools.cache
def copies_in_background(device: torch.device) -> bool:
    """Whether a copy from this device can run beside its other work, and be waited for alone."""
    # It is waited for by an event of PyTorch. On MPS, events are not in order with non-blocking copies.
    return device.type not in ("cpu", "mps") and hasattr(getattr(torch, device.type, None), "Event")
