"""Continue a run from its newest readable checkpoint."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import torch

from skipgs_plug.trainer.errors import DamagedCheckpointError
from skipgs_plug.trainer.state import read_checkpoint

log = logging.getLogger(__name__)

Result = TypeVar("Result")


def lengths(path: Path) -> dict[str, Any]:
    """Return `max_steps` and `schedule_steps` of the run of a checkpoint.

    Raises:
        DamagedCheckpointError: The checkpoint is damaged.
    """
    config = read_checkpoint(path, torch.device("cpu"))["config"]
    return {name: config[name] for name in ("max_steps", "schedule_steps")}


def first_sound(checkpoints: list[Path], use: Callable[[Path], Result]) -> tuple[list[Path], Result]:
    """Use the first checkpoint that is not damaged, and warn about damaged ones.

    Returns:
        The checkpoints from that one on, and the result of `use`.

    Raises:
        DamagedCheckpointError: All checkpoints are damaged. The message names the last one.
    """
    for i, path in enumerate(checkpoints[:-1]):
        try:
            return checkpoints[i:], use(path)
        except DamagedCheckpointError as error:
            log.warning("%s Trying %s.", error, checkpoints[i + 1].name)
    return checkpoints[-1:], use(checkpoints[-1])
