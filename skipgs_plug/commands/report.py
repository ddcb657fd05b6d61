"""`skipgs-plug report RUN...`: one HTML page from gated runs and benches."""

from __future__ import annotations

import os
from pathlib import Path

from skipgs_plug.commands.options.report import Args
from skipgs_plug.core.errors import SkipGSError
from skipgs_plug.report.page import build_page
from skipgs_plug.report.source import read_source
from skipgs_plug.trainer.files import write_aside

SUFFIXES = (".html", ".htm")


def run(args: Args) -> int:
    """Build and write the page; see `Args`."""
    if not args.runs:
        raise SkipGSError("report needs at least one run folder.")
    if args.out.endswith(os.sep):
        raise SkipGSError(f"--out {args.out} is a folder; give the name of a page, such as {args.out}report.html.")
    suffix = Path(args.out).suffix
    if suffix.lower() not in ("", *SUFFIXES):
        raise SkipGSError(f"--out {args.out}: a page is HTML, not {suffix}; give a name that ends in .html.")
    sources = {source.path: source for source in map(read_source, args.runs)}  # a run that is given twice is one run
    page = build_page(list(sources.values()))
    with write_aside(args.out) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="backslashreplace")
    print(args.out)
    return 0
