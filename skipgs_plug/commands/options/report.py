"""Options of `skipgs-plug report`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from skipgs_plug.commands.options.parse import Words, parse_as


@dataclass
class Args:
    """Turn run folders into one HTML page with tables and plots. The page loads nothing from a network."""

    runs: Annotated[tyro.conf.Positional[Words], tyro.conf.arg(metavar="RUN ...")]
    """Folders of `skipgs-plug train`, `run` or `bench`, or their skipgs.json."""
    out: str = "report.html"
    """Page to write."""


def parse(argv: list[str]) -> Args:
    return parse_as(Args, argv, "report")
