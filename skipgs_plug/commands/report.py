"""`skipgs-plug report RUN...`: one HTML page from gated runs and benches."""

from __future__ import annotations

from skipgs_plug.commands.options.report import Args
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.report.page import build_page
from skipgs_plug.report.source import read_source
from skipgs_plug.trainer.files import write_aside


def run(args: Args) -> int:
    """Build and write the page; see `Args`."""
    if not args.runs:
        raise SkipGSError("report needs at least one run folder.")
    page = build_page([read_source(run) for run in args.runs])
    with write_aside(args.out) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace")
    print(args.out)
    return 0
