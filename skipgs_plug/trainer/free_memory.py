"""Memory that is left for this process: free memory of the machine, bounded by its control group."""

from __future__ import annotations

from pathlib import Path

MEMINFO = "proc/meminfo"
CGROUP_V2 = ("sys/fs/cgroup/memory.max", "sys/fs/cgroup/memory.current")  # bytes; "max" for no limit
CGROUP_V1 = ("sys/fs/cgroup/memory/memory.limit_in_bytes", "sys/fs/cgroup/memory/memory.usage_in_bytes")
UNKNOWN = 8 << 30  # bytes of free memory assumed on systems that do not report it, such as macOS and Windows


def free_memory(root: Path = Path("/")) -> int:
    """Return the bytes that can be taken without swapping.

    Args:
        root: Folder with `proc` and `sys` of the kernel.
    """
    found = [size for size in (_available(root), *(_left(root, *names) for names in (CGROUP_V2, CGROUP_V1))) if size]
    return min(found, default=UNKNOWN)


def _available(root: Path) -> int | None:
    try:
        lines = (root / MEMINFO).read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("MemAvailable:"))
    except (OSError, ValueError, IndexError, StopIteration):
        return None


def _left(root: Path, limit: str, used: str) -> int | None:
    try:
        return max(1, int((root / limit).read_text()) - int((root / used).read_text()))
    except (OSError, ValueError):  # no limit, or no control groups here
        return None
