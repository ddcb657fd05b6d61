"""Functions that Windows or macOS lack, and larger pages: guarded where they are used. None of it ran there."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from skipgs_plug.bench import memory as meters
from skipgs_plug.fallback_raster.runtime import buffers, memory
from skipgs_plug.fallback_raster.runtime.cores import usable_cores

LARGE = memory.POOLED_BYTES // 4 + 12_345  # numbers in a tensor that is large enough for memory of its own


def test_cores_where_a_process_cannot_be_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 12)
    assert usable_cores(tmp_path) == 12
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert usable_cores(tmp_path) == 1


@pytest.mark.skipif(not memory.SUPPORTED, reason="no private pages without a file here")
def test_pages_of_16_kibibytes_without_large_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mmap, "PAGESIZE", 1 << 14)
    monkeypatch.delattr(mmap, "MADV_HUGEPAGE", raising=False)
    pool = memory.Pool()
    tensor = pool.empty((LARGE,), torch.float32)
    tensor.fill_(2.0)
    assert float(tensor.double().sum()) == 2.0 * LARGE
    assert pool.mapped >= 4 * LARGE and pool.mapped % (1 << 14) == 0


def test_memory_where_pages_cannot_be_mapped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(buffers, "SUPPORTED", False)
    made = buffers.floats(LARGE)
    assert made.shape == (LARGE,) and made.dtype == torch.float32


def test_threads_where_nothing_forks() -> None:
    code = "import os, torch; os.__dict__.pop('register_at_fork', None)\n"
    code += "from skipgs_plug.fallback_raster import get_num_threads, set_num_threads\n"
    code += "set_num_threads(3); print(get_num_threads())"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.strip() == "3"


def test_peak_memory_is_unknown_without_proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meters, "CLEAR", tmp_path / "clear_refs")
    assert meters.memory_meter(torch.device("cpu")) is None
