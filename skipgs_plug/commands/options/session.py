"""Files and pages of a session, and when they are written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Optional

from skipgs_plug.commands.options.parse import shown
from skipgs_plug.trainer.errors import InputError


@dataclass
class SessionOptions:
    """Files and pages of a session, and when they are written. They do not change the trained model."""

    save_every: Optional[int] = None
    """Iterations between two checkpoints, of which two are kept; default: five minutes of training; 0: the end only."""
    eval_every: int = 0
    """Iterations between two evaluations on the way; 0: the end only."""
    tensorboard: bool = False
    """Log gsplat's scalars and the gate's counters to RUN/tb, every tenth iteration."""
    view: bool = False
    """Show training in the browser; costs at most 2 % of its time."""
    image_memory: Annotated[Optional[float], shown("GB", "a quarter of what is free")] = None
    """Memory for decoded photographs. Photographs that do not fit are decoded again, ahead of their turn."""
    lpips_net: Optional[Literal["alex", "vgg"]] = None
    """Also report LPIPS; its weights must be on this machine."""
    no_progress: bool = False
    """No progress bar."""

    def __post_init__(self) -> None:
        for name in ("save_every", "eval_every"):
            value = getattr(self, name)
            if value is not None and value < 0:
                raise InputError(f"{name}={value} is not a number of iterations; 0 stands for the end only.")
        if self.image_memory is not None and not 0 < self.image_memory < 1e6:
            raise InputError(f"image_memory={self.image_memory} is not an amount of memory; give gigabytes, such as 4.")
