"""The number of threads follows the cores that a process may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from skipgs_plug.fallback_raster.runtime.cores import V1, V2, usable_cores

CGROUP_V2 = f"sys/fs/cgroup/{V2}"
CGROUP_V1 = [f"sys/fs/cgroup/cpu/{name}" for name in V1]


def written(root: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    return root


@pytest.mark.parametrize(
    ("files", "cores"),
    [
        ({}, 64),
        ({CGROUP_V2: "max 100000\n"}, 64),
        ({CGROUP_V2: "200000 100000\n"}, 2),
        ({CGROUP_V2: "150000 100000\n"}, 2),
        ({CGROUP_V2: "10000 100000\n"}, 1),
        ({CGROUP_V2: "9900000 100000\n"}, 64),
        ({CGROUP_V2: "nonsense\n"}, 64),
        ({CGROUP_V2: "200000 0\n"}, 64),
        (dict(zip(CGROUP_V1, ("300000\n", "100000\n"), strict=True)), 3),
        (dict(zip(CGROUP_V1, ("-1\n", "100000\n"), strict=True)), 64),
    ],
)
def test_the_quota_of_a_container_counts(tmp_path, monkeypatch, files, cores) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)), raising=False)
    assert usable_cores(written(tmp_path, files)) == cores


@pytest.mark.parametrize(
    ("listed", "folder", "files"),
    [
        ("0::/user.slice/job", "", {V2: "300000 100000"}),
        ("7:cpu,cpuacct:/user.slice/job", "cpu/", dict(zip(V1, ("300000", "100000"), strict=True))),
    ],
)
def test_each_group_around_the_process_counts(tmp_path, monkeypatch, listed, folder, files) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)), raising=False)
    outer = {f"sys/fs/cgroup/{folder}user.slice/{name}": text for name, text in files.items()}
    written(tmp_path, {"proc/self/cgroup": f"12:pids:/\n{listed}\n", **outer})
    assert usable_cores(tmp_path) == 3
    inner = {f"sys/fs/cgroup/{folder}user.slice/job/{name}": text.replace("300", "100") for name, text in files.items()}
    assert usable_cores(written(tmp_path, inner)) == 1


def test_binding_counts_too(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3}, raising=False)
    assert usable_cores(written(tmp_path, {CGROUP_V2: "400000 100000"})) == 1
