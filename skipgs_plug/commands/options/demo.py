"""Options of `skipgs-plug demo`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from skipgs_plug.commands.options.parse import parse_as


@dataclass
class Args:
    """Train a small ray-traced scene as it is, with the paper's gate and with share="auto". No download."""

    out: str = "skipgs_demo"
    """Folder for models, pictures and numbers."""
    max_steps: int = 1500
    """Iterations of the schedule; the first half densifies."""
    views: int = 48
    """Images on the dome around the scene; every 8th is held out."""
    width: int = 128
    """Image width; height is three quarters of it."""
    points: int = 4000
    """Surface points to start from."""
    backend: Literal["auto", "gsplat", "warp"] = "auto"
    """gsplat on CUDA, warp on the CPU; auto: gsplat if CUDA works, else warp."""
    seed: int = 42
    """Seed of training."""
    no_progress: bool = False
    """No progress bars."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "demo")
