"""Limits of this process: the control groups that hold it, and the memory that they leave of the machine's."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

MEMINFO, GROUPS = "proc/meminfo", "proc/self/cgroup"
ROOT = "sys/fs/cgroup"  # groups of version 2; version 1 has a folder for each controller in it
UNKNOWN = 8 << 30  # bytes of free memory assumed on systems that do not report it, such as macOS and Windows


class Version(NamedTuple):
    """The names of the files in each group of a version of control groups.

    Attributes:
        controller: Name in the list of the process's groups; version 2 has none.
        limit, used: Files with the allowed and the used bytes. A limit can be "max".
        cache: Entry of memory.stat: bytes of files that the kernel drops when memory is needed. They count as used.
    """

    controller: str
    limit: str
    used: str
    cache: str


V2 = Version("", "memory.max", "memory.current", "inactive_file")
V1 = Version("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")


def free_memory(root: Path = Path("/")) -> int:
    """Return the bytes that can be taken without swapping.

    Args:
        root: Folder with `proc` and `sys` of the kernel.
    """
    groups = [(group, version) for version in (V2, V1) for group in groups_of_process(root, version.controller)]
    sizes = [_available(root), *(_left(group, version) for group, version in groups)]
    return min((size for size in sizes if size is not None), default=UNKNOWN)


def groups_of_process(root: Path, controller: str = "") -> Iterator[Path]:
    """Yield the folders of the groups that hold this process, from the innermost on. Each can have a limit.

    Args:
        root: Folder with `proc` and `sys` of the kernel.
        controller: Name of a controller of version 1; empty for version 2.
    """
    try:
        lines = [line.split(":", 2) for line in (root / GROUPS).read_text().splitlines()]
        name = next(path for _, controllers, path in lines if controller in controllers.split(","))
    except (OSError, ValueError, StopIteration):
        name = "/"
    inner = PurePosixPath(name.lstrip("/"))
    # A container can show its own group as the uppermost one, and a name that has no folder in it.
    return (root / ROOT / controller / group for group in (inner, *inner.parents))


def _available(root: Path) -> int | None:
    try:
        return _entry(root / MEMINFO, "MemAvailable:") * 1024
    except (OSError, ValueError):
        return None


def _left(group: Path, version: Version) -> int | None:
    try:
        left = int((group / version.limit).read_text()) - int((group / version.used).read_text())
    except (OSError, ValueError):  # no limit, or no control groups here
        return None
    with contextlib.suppress(OSError, ValueError):
        left += _entry(group / "memory.stat", version.cache)
    return max(1, left)


def _entry(file: Path, name: str) -> int:
    """Return the number after a name in a file of the kernel.

    Raises:
        OSError: There is no such file.
        ValueError: There is no such entry, or no number after it.
    """
    for line in file.read_text().splitlines():
        words = line.split()
        if len(words) > 1 and words[0] == name:
            return int(words[1])
    raise ValueError(f"{file} has no entry {name}.")
