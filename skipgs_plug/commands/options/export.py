"""Options of `skipgs-plug export`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from skipgs_plug.commands.options.parse import parse_as


@dataclass
class Args:
    """Convert the last model of a run folder, or any 3DGS PLY, .splat or .spz. The ending of FILE sets the format.

    .compressed.ply: SuperSplat, PlayCanvas; 61 bytes per Gaussian, invisible ones left out.
    .splat: antimatter15 and most web viewers; 32 bytes, colours that do not change with direction.
    .spz: phones, glTF, Niantic's and most web viewers; about 20 bytes, colours that change with direction.
    .sog: SuperSplat, PlayCanvas, most web viewers; about 15 bytes, colours that change with direction.
    .ply: 62 properties, exact.
    """

    model: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="MODEL")]
    """Run folder, PLY, .splat or .spz."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """File to write."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "export")
