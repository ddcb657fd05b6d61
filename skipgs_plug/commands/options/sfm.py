"""Options of `skipgs-plug sfm`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skipgs_plug.commands.options.parse import parse_as
from skipgs_plug.photos.choices import Mapping, Matching


@dataclass
class Args:
    """Reconstruct where photographs were taken (COLMAP, on the CPU) and write a scene for `skipgs-plug train`.

    Up to 100 photographs are matched in all pairs and placed one after another. More photographs are matched with
    their neighbours in the order of names and placed all at once.
    """

    photos: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photographs, or a video."""
    scene: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE")]
    """COLMAP folder to write: images, images_2, images_4, images_8, sparse/0."""
    frames: int = 100
    """Frames to take from a video, each the sharpest of its group."""
    matching: Matching = "auto"
    """Pairs of photographs to compare: all (exhaustive), or neighbours in the order of names (sequential)."""
    mapping: Mapping = "auto"
    """Place photographs one after another (incremental) or all at once (global)."""
    no_progress: bool = False
    """No progress bars."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "sfm")
