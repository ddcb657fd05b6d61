"""The number of cores that this process may use: its affinity mask, limited by the quota of its control group."""

from __future__ import annotations

import math
import os
from pathlib import Path

CGROUP_V2 = "sys/fs/cgroup/cpu.max"  # "quota period" in microseconds, or "max period"
CGROUP_V1 = ("sys/fs/cgroup/cpu/cpu.cfs_quota_us", "sys/fs/cgroup/cpu/cpu.cfs_period_us")


def usable_cores(root: Path = Path("/")) -> int:
    """Return the number of threads that can run at the same time, at least 1.

    A container with a quota of two CPUs on a machine with 64 cores sees all 64 in its affinity mask. The scheduler
    would stop 64 threads most of the time.

    Args:
        root: Root folder of the operating system's files.
    """
    bound = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = _quota(root)
    return bound if quota is None else max(1, min(bound, math.ceil(quota)))


def _quota(root: Path) -> float | None:
    """Return the CPUs that the control group grants. None if there is no limit, or if it cannot be read."""
    try:
        if (root / CGROUP_V2).is_file():
            quota, period = (root / CGROUP_V2).read_text().split()
        else:
            quota, period = ((root / name).read_text().strip() for name in CGROUP_V1)
        granted = float(quota) / float(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None
    return granted if granted > 0 else None
