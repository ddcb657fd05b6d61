"""Batches of the script of gsplat, shown at half their size while `Hooks.at_half_size`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from skipgs_plug.core.half_size import can_be_halved, halved, in_unit_range, some_of
from skipgs_plug.core.hooks import Hooks

# Entries of a batch whose meaning at half the size is known. Points of a depth loss, for example, are in pixels.
ENTRIES = frozenset({"K", "camtoworld", "image", "image_id", "camera_idx", "mask", "exposure"})


def show_half_size_batches(hooks: Hooks, runner: Any) -> Callable[[], Iterator[Tensor]] | None:
    """Show batches of training photographs at half their size while `Hooks.at_half_size`.

    Args:
        hooks: Reports to the gate, and replaces names in the trainer.
        runner: The `Runner` of the script.

    Returns:
        Returns some training photographs, as `TrainerInfo.photographs` does; None if nothing was replaced, because the
        settings do not allow smaller photographs, or their meaning in this run is not known.
    """
    # Cameras of NCore have coefficients in pixels, and post-processing knows places in the image.
    known = not hasattr(runner, "ncore_camera_data") and getattr(runner.cfg, "post_processing", None) is None
    whole = getattr(runner.cfg, "patch_size", 0) is None
    dataset = runner.trainset
    if not (hooks.may_halve and known and whole and dataset[0].keys() <= ENTRIES):
        return None

    def begun(original: Callable[..., Iterator[Any]], loader: DataLoader[Any]) -> Iterator[Any]:
        batches = original(loader)
        return _Batches(batches, hooks, runner.device) if loader.dataset is dataset else batches

    hooks.wrap(DataLoader, "__iter__", begun)
    return lambda: (in_unit_range(dataset[i]["image"]) for i in some_of(len(dataset)))


class _Batches:
    """Batches of a loader, those of some iterations at half their size.

    Args:
        batches: Returns batches with `image` [N, H, W, 3], `K` [N, 3, 3] and perhaps `mask` [N, H, W].
        hooks: Says which iterations have half the size.
        device: Device of the model. The script copies photographs there, and they are halved there.
    """

    def __init__(self, batches: Iterator[Any], hooks: Hooks, device: torch.device | str) -> None:
        self._batches = batches
        self._hooks = hooks
        self._device = device

    def __iter__(self) -> Iterator[Any]:
        return self

    def __next__(self) -> Any:
        batch = next(self._batches)
        with self._hooks.guarded():
            if self._hooks.at_half_size and can_be_halved(*batch["image"].shape[1:3]):
                return self._at_half_size(batch)
        return batch

    def _at_half_size(self, batch: dict[str, Any]) -> dict[str, Any]:
        image = batch["image"].to(self._device)
        smaller = halved(image.movedim(-1, 1)).movedim(1, -1).contiguous()
        K = batch["K"].clone()
        for axis, size in ((0, 2), (1, 1)):
            K[:, axis] *= smaller.shape[size] / image.shape[size]
        masked = {"mask": halved(batch["mask"].to(self._device))} if "mask" in batch else {}
        return {**batch, **masked, "image": smaller, "K": K}
