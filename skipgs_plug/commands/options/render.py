"""Options of `skipgs-plug render`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, Optional

import tyro

from skipgs_plug.commands.options.parse import parse_as


@dataclass
class Args:
    """Render the last model of a run folder, or any 3DGS PLY, .splat or .spz, along a path or from held-out cameras."""

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Run folder, PLY, .splat or .spz."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PATH")]
    """Film to write (.mp4), or folder for PNG files."""
    scene: Optional[str] = None
    """Scene with the cameras; default: the scene that the run folder names."""
    cameras: Literal["path", "held-out"] = "path"
    """A path through the training cameras in the order of names, or each held-out camera."""
    show: Literal["colour", "depth", "both"] = "colour"
    """Colour, depth (red is near), or both side by side."""
    frames: int = 240
    """Length of the path."""
    fps: int = 30
    """Frames per second of a film."""
    data_factor: Optional[int] = None
    """Factor by which frames are reduced, like the scene's images_{factor}; default: as in training."""
    backend: str = "auto"
    """auto, gsplat (CUDA) or warp (CPU)."""
    no_progress: bool = False
    """No progress bar."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "render")
