"""Which files the site is made of: pages lie where GitHub shows them, so one set of relative links serves both."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PAGES = (
    "*.md",
    "docs/**/*.md",
    "docs/**/*.png",
    "docs/site.css",
    "examples/*.md",
    "examples/*.py",
    "tests/SITUATIONS.md",
    "benchmarks/*.py",
    "benchmarks/notes/*.md",
    "benchmarks/results/**/table.md",
    "benchmarks/results/**/*.png",
    "benchmarks/results/*.json",
)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Replace the files of `docs/` by all files that pages of the repository link to; README.md is the first page."""
    for file in list(files):
        if not file.inclusion.is_excluded() and not file.src_uri.startswith("assets/"):
            files.remove(file)
    found = {path.relative_to(ROOT).as_posix() for pattern in PAGES for path in ROOT.glob(pattern)}
    for name in sorted(found):
        files.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    return files
