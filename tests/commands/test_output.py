"""Output that cannot be written: a log on a full disk, a terminal that was closed, a reader who is gone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from skipgs_plug.trainer import save_packed
from skipgs_plug.trainer.synthetic import make_scene

TRAIN = ["--max-steps", "60", "--eval-every", "20"]
FULL = Path("/dev/full")
LOST = "skipgs-plug: Part of the output could not be written (No space left on device), but all else is done"


@pytest.fixture(scope="module")
def packed(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), path)
    return str(path)


def command(*arguments: str, **streams: object) -> subprocess.CompletedProcess[str]:
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **streams}
    python = [sys.executable, "-m", "skipgs_plug"]
    return subprocess.run([*python, *arguments], text=True, check=False, timeout=300, **streams)  # type: ignore


def is_complete(out: Path) -> bool:
    files = ("ckpts/ckpt_59_rank0.pt", "ply/point_cloud_59.ply", "stats/val_step59.json", "stats/train_curve.json")
    return all((out / name).is_file() for name in files)


@pytest.mark.skipif(not FULL.exists(), reason="needs the full device of Linux")
@pytest.mark.parametrize("streams", [("stdout",), ("stderr",), ("stdout", "stderr")])
def test_a_log_on_a_full_disk_does_not_cost_the_run(streams: tuple[str, ...], packed: str, tmp_path: Path) -> None:
    with FULL.open("w") as full:
        tried = command("train", packed, "--out", str(tmp_path), *TRAIN, **dict.fromkeys(streams, full))
    assert tried.returncode == 2 and is_complete(tmp_path)
    if tried.stderr is not None:
        assert LOST in tried.stderr
    if tried.stdout is not None:
        assert f"view {tmp_path}" in tried.stdout


@pytest.mark.skipif(os.name == "nt", reason="needs a terminal of POSIX")
def test_a_terminal_that_was_closed_does_not_cost_the_run(packed: str, tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    os.close(ours)
    tried = command("train", packed, "--out", str(tmp_path), *TRAIN, stdin=theirs, stdout=theirs, stderr=theirs)
    os.close(theirs)
    assert tried.returncode == 2 and is_complete(tmp_path)


@pytest.mark.skipif(not FULL.exists(), reason="needs the full device of Linux")
def test_help_that_nobody_can_read_is_no_success() -> None:
    with FULL.open("w") as full:
        tried = command("train", "--help", stdout=full)
    assert tried.returncode == 2 and tried.stderr.startswith(LOST) and tried.stderr.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="pipes of Windows give another error")
def test_a_reader_who_is_gone_at_the_end_costs_no_file(packed: str, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    options = ["--max-steps", "60", "--no-progress", "--gate"]  # nothing is written to the pipe before the end
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    tried = command("train", packed, "--out", str(tmp_path), *options, stdout=write, env=environment)
    os.close(write)
    assert tried.returncode == 141 and tried.stderr == ""
    assert is_complete(tmp_path) and (tmp_path / "skipgs.json").is_file()
