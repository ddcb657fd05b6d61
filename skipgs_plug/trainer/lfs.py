"""Git LFS pointers: three lines of text in place of a large file that was not fetched."""

from __future__ import annotations

from pathlib import Path

START = b"version https://git-lfs"
HINT = "it is a Git LFS pointer, the file itself was not fetched; run: git lfs pull"


def is_pointer(path: Path) -> bool:
    try:
        with open(path, "rb") as stream:
            return stream.read(len(START)) == START
    except OSError:
        return False
