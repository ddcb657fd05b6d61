"""The number of threads follows the cores that a process may use."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from skipgs_plug.fallback_raster.runtime.cores import CGROUP_V1, CGROUP_V2, usable_cores


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


def test_binding_counts_too(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3}, raising=False)
    assert usable_cores(written(tmp_path, {CGROUP_V2: "400000 100000"})) == 1
