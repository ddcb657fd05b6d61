"""The control groups of Linux that hold this process."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath

LISTED = "proc/self/cgroup"
ROOT = "sys/fs/cgroup"  # version 2; version 1 has a folder for each controller in it


def groups_of_process(root: Path, controller: str = "") -> Iterator[Path]:
    """Yield the folders of the groups that hold this process, from the innermost on. Each can have a limit.

    Args:
        root: Folder with `proc` and `sys` of the kernel.
        controller: Name of a controller of version 1; empty for version 2.
    """
    try:
        lines = [line.split(":", 2) for line in (root / LISTED).read_text().splitlines()]
        name = next(path for _, controllers, path in lines if controller in controllers.split(","))
    except (OSError, ValueError, StopIteration):
        name = "/"
    inner = PurePosixPath(name.lstrip("/"))
    # A container can show its own group as the uppermost one, and a name that has no folder in it.
    return (root / ROOT / controller / group for group in (inner, *inner.parents))
