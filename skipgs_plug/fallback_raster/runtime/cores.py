"""The number of cores that this process may use: its affinity mask, limited by the quotas of its control groups."""

from __future__ import annotations

import math
import os
from pathlib import Path

from skipgs_plug.limits import groups_of_process

V2 = "cpu.max"  # "quota period" in microseconds, or "max period"
V1 = ("cpu.cfs_quota_us", "cpu.cfs_period_us")


def usable_cores(root: Path = Path("/")) -> int:
    """Return the number of threads that can run at the same time, at least 1.

    A container with a quota of two CPUs on a machine with 64 cores sees all 64 in its affinity mask. The scheduler
    would stop 64 threads most of the time.

    Args:
        root: Root folder of the operating system's files.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    groups = [
        (group, names)
        for names, controller in (((V2,), ""), (V1, "cpu"))
        for group in groups_of_process(root, controller)
    ]
    quotas = [quota for quota in (_quota(group, names) for group, names in groups) if quota is not None]
    return max(1, min([bound, *map(math.ceil, quotas)]))


def _quota(group: Path, names: tuple[str, ...]) -> float | None:
    """Return the CPUs that a group grants, by the files with these names. None if it has no limit."""
    try:
        quota, period = " ".join((group / name).read_text() for name in names).split()
        granted = float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None
    return granted if granted > 0 else None
