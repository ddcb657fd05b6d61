"""Options of `skipgs-plug view`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from skipgs_plug.commands.options.parse import parse_as


@dataclass
class Args:
    """Serve a page with the model, its cameras, and photographs beside renders and errors, until Ctrl-C."""

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Run folder or PLY."""
    scene: str | None = None
    """Scene with the photographs; default: the scene of the run folder. A PLY needs no scene."""
    data_factor: int | None = None
    """Reduction of the photographs; default: as in training."""
    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 lets other machines of the network in."""
    port: int = 8080
    """Port to listen on; the next free one is taken."""
    backend: str = "auto"
    """auto, gsplat (CUDA) or warp (CPU)."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "view")
