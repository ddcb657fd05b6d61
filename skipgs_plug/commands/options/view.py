"""Options of `skipgs-plug view`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Optional

import tyro

from skipgs_plug.commands.options.parse import parse_as


@dataclass
class Args:
    """Serve a page with the model, and with held-out photographs beside their renders, until Ctrl-C.

    It works on phones too: one finger turns, two fingers move, and a button changes to flying.
    """

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Run folder, PLY, .splat or .spz."""
    scene: Optional[str] = None
    """Scene with the photographs; default: the scene of the run folder. A PLY needs no scene."""
    data_factor: Optional[int] = None
    """Factor by which photographs are reduced; default: as in training."""
    cameras: bool = False
    """Serve the page for finding errors: all cameras and models of the run, and the PSNR of every held-out view."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines of the network in."""
    port: int = 8080
    """Port to listen on. If it is taken, the next free one is used."""
    backend: str = "auto"
    """auto, gsplat (CUDA) or warp (CPU)."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "view")
