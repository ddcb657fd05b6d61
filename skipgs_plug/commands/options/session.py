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
    """Iterations between checkpoints; the last two are kept. Default: five minutes of training. 0: only at the end."""
    eval_every: int = 0
    """Iterations between two evaluations. 0: only at the end."""
    tensorboard: bool = False
    """Log gsplat's scalars and the gate's counters to RUN/tb, every tenth iteration."""
    view: bool = False
    """Show training in the browser; costs at most 2 % of its time."""
    image_memory: Annotated[Optional[float], shown("GB", "a quarter of the free memory")] = None
    """Memory for decoded photographs. Photographs that do not fit are decoded anew before they are needed."""
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
