"""`skipgs-plug report RUN...`: one HTML page from gated runs and benches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro

from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.report.page import build_page
from skipgs_plug.report.source import read_source
from skipgs_plug.trainer.files import write_aside


@dataclass
class Args:
    """Turn run folders into one self-contained HTML page: tables and plots inside, nothing loaded from a network."""

    runs: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="RUN ...")]
    """Folders of `skipgs-plug train`, `run` or `bench`, or their skipgs.json."""
    out: str = "report.html"
    """Page to write."""


def main(argv: list[str]) -> int:
    args = tyro.cli(Args, args=argv, prog="skipgs-plug report", config=(tyro.conf.FlagCreatePairsOff,))
    if not args.runs:
        raise SkipGSError("report needs at least one run folder.")
    page = build_page([read_source(run) for run in args.runs])
    with write_aside(args.out) as temporary:
        temporary.write_text(page, encoding="utf-8")
    print(args.out)
    return 0
