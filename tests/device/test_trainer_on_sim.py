"""The trainer of this package on a device reads once per iteration; benchmarks/gpu runs on that device."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks.gpu.__main__ import table
from benchmarks.gpu.measure import GATES, LONGEST, SHORTEST, Deadline, schedule
from benchmarks.gpu.script import find_script
from skipgs_plug.trainer.photographs import Photographs
from skipgs_plug.trainer.synthetic import make_scene
from tests.device.test_lookalikes import has_backend

HERE = Path(__file__).parent
on_sim = pytest.mark.skipif(not has_backend(), reason=f"torch {torch.__version__} has no backends in Python")


@pytest.fixture(scope="module")
def measured() -> dict[str, Any]:
    args = [sys.executable, str(HERE / "trainer_on_sim.py")]
    done = subprocess.run(args, capture_output=True, text=True, timeout=280)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)  # type: ignore[no-any-return]


@on_sim
@pytest.mark.parametrize("photographs", ["resident", "ahead"])
def test_an_iteration_reads_its_loss_behind_the_backward_and_nothing_else(measured, photographs):
    reads = {kind: count for kind, _, _, count in measured[photographs]}
    assert reads == {
        "waited for a copy": 10,
        "synchronize": 1,
    }  # one wait in each of ten iterations, one synchronisation at the end


@on_sim
def test_the_command_for_a_gpu_compares_from_one_snapshot(measured):
    found = measured["compare"]
    assert found["runs"].keys() == GATES.keys() and not found["left_out"]
    off, gate, share = (found["runs"][name] for name in GATES)
    assert off["iterations"] == gate["iterations"] > share["iterations"] and off["backwards_skipped"] == 0
    # One read in each of 20 iterations, and two at the end of `train`.
    assert 1.0 <= off["waits_per_iteration"] <= 1.15 and gate["backwards_skipped"] > 0
    assert gate["peak_bytes_first_skip"] is not None and off["peak_bytes_first_skip"] is None
    text = table({"device": "sim", "trainer": found, "script": None})
    assert text.count("\n| ") == 1 + len(GATES) and "give --script" in text


def test_a_schedule_fits_into_the_time():
    assert schedule(300.0, 0.01) == 7500
    assert schedule(300.0, 1e-6) == LONGEST and schedule(1.0, 10.0) == SHORTEST


def test_time_that_is_over_is_none():
    clock = iter([0.0, 10.0, 100.0])
    deadline = Deadline(30.0, lambda: next(clock))
    assert deadline.left == 20.0 and deadline.left == 0.0


def test_a_script_that_is_not_there_is_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert find_script(str(tmp_path / "simple_trainer.py")) is None
    (tmp_path / "simple_trainer.py").touch()
    monkeypatch.setenv("SKIPGS_SCRIPT", str(tmp_path / "simple_trainer.py"))
    assert find_script(None) == tmp_path / "simple_trainer.py"


def test_without_a_gpu_the_command_says_so():
    args = [sys.executable, "-m", "benchmarks.gpu", "nowhere"]
    done = subprocess.run(args, capture_output=True, text=True, cwd=HERE.parents[1], env={"CUDA_VISIBLE_DEVICES": ""})
    assert done.returncode == 2 and "no CUDA device" in done.stderr


def test_photographs_on_the_cpu_are_those_of_the_scene():
    scene = make_scene(n_views=4, width=24, height=20, n_points=30)
    photographs = Photographs(scene.train, torch.device("cpu"))
    photographs.begin(scene.train[1])
    assert photographs.resident and photographs.on_device(scene.train[0]) is scene.train[0]
