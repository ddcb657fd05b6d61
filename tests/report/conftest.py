"""Folders of every kind that a report reads, and a browser to open it in."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from browser import FLAGS, find_chromium
from report_browser import COUNT_IMAGES

from skipgs_plug import SkipGate
from skipgs_plug.cli import main
from skipgs_plug.core.report import write_report
from skipgs_plug.trainer import save_packed
from skipgs_plug.trainer.synthetic import make_scene


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    save_packed(make_scene(n_views=8, width=24, height=16, n_points=60, test_every=4), path)
    return str(path)


@pytest.fixture(scope="session")
def train_folder(scene_file: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder of `skipgs-plug train`."""
    folder = tmp_path_factory.mktemp("train") / "gated"
    assert main(["train", scene_file, "--out", str(folder), "--gate", "--max-steps", "40", "--no-progress"]) == 0
    return folder


@pytest.fixture(scope="session")
def ungated_folder(scene_file: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("train") / "ungated"
    command = ["train", scene_file, "--out", str(folder), "--max-steps", "40", "--no-progress"]
    assert main(command) == 0
    return folder


@pytest.fixture(scope="session")
def bench_folder(scene_file: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bench") / "small"
    command = ["bench", scene_file, "--out", str(folder), "--max-steps", "40", "--seeds", "0", "--no-progress"]
    assert main([*command, "--policies", "own", "gate", "random"]) == 0
    return folder


@pytest.fixture(scope="session")
def script_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The output folder of a gated script of another project: files of its own format, and skipgs.json."""
    folder = tmp_path_factory.mktemp("script") / "output & <model>"
    gate = SkipGate(start_iter=5, warmup=6)
    for step in range(60):
        loss = torch.tensor(1.0 + (step * 7 % 5) / 10, requires_grad=True)
        gate.backward(loss, view=f"cam/{step % 3}<b>.png", step=step)
    write_report(gate, folder / "skipgs.json")
    (folder / "cfg_args").write_text("Namespace()")
    return folder


@pytest.fixture
def dump_dom(tmp_path: Path) -> Callable[[Path], str]:
    """Open a page in a headless browser and return its DOM, with the number of decoded images in <body>."""
    browser = find_chromium()

    def dump(page: Path) -> str:
        copy = tmp_path / "copy.html"
        copy.write_text(page.read_text().replace("</body>", COUNT_IMAGES + "</body>"))
        profile = f"--user-data-dir={tmp_path / 'profile'}"
        command = [browser, *FLAGS, profile, "--dump-dom", copy.as_uri()]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout

    return dump
