"""TensorBoard scalars of a run, with the tags of gsplat's examples/simple_trainer.py."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch

from skipgs_plug.files import WriteError, keep_going
from skipgs_plug.trainer.loop import Iteration, Trainer
from skipgs_plug.trainer.metrics import METRICS

EVERY = 10  # iterations between two logged points; a point costs two evaluations of the loss


class ScalarLog:
    """Writes scalars of a training run into a folder for TensorBoard.

    A resumed run continues its folder: TensorBoard drops older points from the present iteration on. If the disk is
    full, the curves end and training continues.

    Args:
        folder: The folder.
        trainer: The trainer.
        more: Returns further scalars with their own tags. It is called at each written iteration.
    """

    def __init__(self, folder: Path, trainer: Trainer, more: Callable[[], Mapping[str, float]] = dict) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self._trainer, self._more = trainer, more
        self._writer = SummaryWriter(str(folder), purge_step=trainer.step)
        self._failed: list[WriteError] = []

    def iteration(self, iteration: Iteration) -> None:
        """Write `train/loss l1loss ssimloss num_GS mem` of every tenth iteration; may serve as `Trainer.on_step`."""
        if not iteration.passes(EVERY):
            return
        trainer, image, target = self._trainer, iteration.image, iteration.target
        with torch.no_grad():  # the trainer computes both parts of the loss at once
            l1, ssim = (float(trainer.backend.loss(image, target, weight)) for weight in (0.0, 1.0))
        scalars = {"loss": iteration.loss, "l1loss": l1, "ssimloss": ssim, "num_GS": trainer.num_gaussians}
        memory = peak_memory(trainer.backend.device)
        if memory is not None:
            scalars["mem"] = memory / 2**30
        self._write({f"train/{name}": value for name, value in scalars.items()} | dict(self._more()), iteration.step)

    def evaluation(self, stats: Mapping[str, Any], split: str = "val") -> None:
        """Write `val/psnr ssim lpips num_GS` of an evaluation: all metrics under their tags, and the model's size."""
        tags = {metric.name: metric.tag or metric.name for metric in METRICS.values()} | {"num_GS": "num_GS"}
        shown = {f"{split}/{tag}": stats[name] for name, tag in tags.items() if name in stats}
        self._write(shown, self._trainer.step - 1)

    def _write(self, scalars: Mapping[str, float], step: int) -> None:
        if self._failed:
            return
        with keep_going(self._failed):
            for tag, value in scalars.items():
                self._writer.add_scalar(tag, value, step)

    def __enter__(self) -> ScalarLog:
        return self

    def __exit__(self, *error: object) -> None:
        with keep_going(self._failed):
            self._writer.close()


def peak_memory(device: torch.device) -> int | None:
    """Return the peak memory in bytes: torch's on the GPU, else the process's; None on Windows."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    if status.exists():  # getrusage on Linux also counts memory of the parent process before this one started
        (kibibytes,) = re.findall(r"^VmHWM:\s*(\d+) kB$", status.read_text(), re.MULTILINE)
        return int(kibibytes) * 1024
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024
