"""Photographs during training on a GPU: in its memory, or in pinned memory and copied ahead."""

from __future__ import annotations

import dataclasses
import logging
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from skipgs_plug.trainer.image_store import StreamedView
from skipgs_plug.trainer.scene import View

log = logging.getLogger(__name__)

SHARE = 0.25  # largest share of the device's free memory for photographs: the model grows into the rest


class Photographs:
    """Provides training views whose tensors are on the device.

    On the CPU, views do not change. Photographs that fit into a quarter of the device's free memory are copied there
    once. Otherwise they stay in pinned memory, and the next one is copied in a separate stream during the present
    iteration. Poses, intrinsics and masks are small and always stay on the device.

    Args:
        views: Training views.
        device: Device of the model.
        free_bytes: Free memory of the device in bytes; None to ask the device.

    Attributes:
        resident: Whether photographs stay on the device.
    """

    def __init__(self, views: Sequence[View], device: torch.device, free_bytes: int | None = None) -> None:
        self._device = device
        self._views: dict[str, View] = {}  # views by name; all but the photograph is on the device
        self._ahead: dict[str, tuple[Tensor, Any]] = {}  # at most one copy under way, and the event that ends it
        self._backend: Any = getattr(torch, device.type, None)
        self._stream: Any = None
        self.resident = True
        if device.type == "cpu":
            return
        size = sum(3 * view.width * view.height for view in views)
        bound = int(SHARE * (_free_bytes(self._backend) if free_bytes is None else free_bytes))
        self.resident = size <= bound
        if not self.resident:
            log.info(
                "%d photographs (%.1f GiB) stay in the host's memory and are copied ahead: they are more than a "
                "quarter of the %.1f GiB that are free on %s.",
                len(views),
                size / 2**30,
                bound / SHARE / 2**30,
                device,
            )

    def on_device(self, view: View) -> View:
        """Return a view with all its tensors on the device. The host does not wait for the copy."""
        if self._device.type == "cpu":
            return view
        if self._streams(view):
            return self._kept(view)
        kept = self._views.get(view.name)
        if kept is None:
            kept = self._views[view.name] = self._kept(view)
        if self.resident:
            return kept
        if view.name not in self._ahead:
            self.begin(view)
        image, event = self._ahead.pop(view.name)
        if event is not None:
            stream = self._backend.current_stream()
            event.wait(stream)
            image.record_stream(stream)
        return dataclasses.replace(kept, image=image)

    def begin(self, view: View) -> None:
        """Start to copy the photograph of the next view."""
        if self._device.type == "cpu" or self.resident or view.name in self._ahead or self._streams(view):
            return
        self._ahead.clear()
        kept = self._views.get(view.name)
        if kept is None:
            kept = self._views[view.name] = self._kept(view)
        if not hasattr(self._backend, "Stream"):
            self._ahead[view.name] = (kept.image.to(self._device, non_blocking=True), None)
            return
        if self._stream is None:
            self._stream = self._backend.Stream()
        with self._backend.stream(self._stream):
            image = kept.image.to(self._device, non_blocking=True)
            event = self._backend.Event()
            event.record(self._stream)
        self._ahead[view.name] = (image, event)

    def _streams(self, view: View) -> bool:
        """Whether neither the device nor the host has room to keep the photograph; see `ImageStore`."""
        return isinstance(view, StreamedView) and not self.resident

    def _kept(self, view: View) -> View:
        def there(tensor: Tensor) -> Tensor:
            return tensor.to(self._device)

        return View(
            view.name,
            there(view.image) if self.resident or self._streams(view) else _pinned(view.image),
            there(view.K.float()),
            there(view.viewmat.float()),
            None if view.mask is None else there(view.mask),
        )


def _free_bytes(backend: Any) -> int:
    ask: Callable[[], tuple[int, int]] | None = getattr(backend, "mem_get_info", None)
    return 0 if ask is None else ask()[0]


def _pinned(image: Tensor) -> Tensor:
    try:
        return image.pin_memory()
    except RuntimeError:  # the system allows no more pinned memory; copies then block the host
        return image
