"""A short run with a checkpoint, a PLY and a configuration."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from skipgs_plug.cli import main
from skipgs_plug.trainer import save_packed
from skipgs_plug.trainer.synthetic import make_scene


@pytest.fixture(scope="session")
def scene_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight views of 33x24, two of them held out; the right half of one of these does not count, and is wrong."""
    path = tmp_path_factory.mktemp("scene") / "tiny.npz"
    scene = make_scene(n_views=8, width=33, height=24, n_points=160, test_every=4)
    view = scene.test[0]
    view.mask = torch.ones(view.height, view.width, dtype=torch.bool)
    view.mask[:, 16:] = False
    view.image[:, 16:] = 255 - view.image[:, 16:]
    save_packed(scene, path)
    return path


@pytest.fixture(scope="session")
def run_folder(scene_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "tiny"
    command = ["train", str(scene_file), "--out", str(folder), "--max-steps", "40", "--no-progress"]
    assert main(command) == 0
    return folder


@pytest.fixture
def ply(run_folder: Path) -> Path:
    return run_folder / "ply/point_cloud_39.ply"
