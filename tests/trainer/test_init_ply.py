"""--init-ply: training starts from a point cloud or from the Gaussians of another run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from scene_folders import write_blender

from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.ply import read_ply
from skipgs_plug.trainer.row_order import morton_order


@pytest.fixture
def folder(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_blender(tiny_scene, tmp_path / "toy")


def write_cloud(path: Path, n: int) -> np.ndarray:
    xyz = np.random.default_rng(0).normal(size=(n, 3)).astype(np.float32)
    vertices = np.array([tuple(row) for row in xyz], dtype=[(name, "f4") for name in "xyz"])
    PlyData([PlyElement.describe(vertices, "vertex")]).write(str(path))
    return xyz


def test_point_cloud(tmp_path: Path, folder: Path) -> None:
    xyz = write_cloud(tmp_path / "cloud.ply", 60)
    config = TrainConfig(init_ply=str(tmp_path / "cloud.ply"), max_steps=2)
    scene = load_scene(folder, init_num_pts=50, init_ply=config.init_ply)
    trainer = Trainer(config, scene)
    order = morton_order(torch.from_numpy(xyz))
    np.testing.assert_array_equal(trainer.splats["means"].detach(), xyz[order])
    assert float(torch.sigmoid(trainer.splats["opacities"].detach()).max()) == pytest.approx(0.1)
    trainer.train(progress=False)
    write_cloud(tmp_path / "cloud.ply", 3)
    with pytest.raises(InputError, match=r"cloud\.ply has 3 points, but at least 4"):
        load_scene(folder, init_ply=tmp_path / "cloud.ply")


def test_a_folder_is_no_point_cloud(tmp_path: Path, folder: Path) -> None:
    with pytest.raises(InputError, match="is a folder; give the path of a PLY"):
        load_scene(folder, init_ply=tmp_path)


@pytest.mark.parametrize("degree", [1, 3])
def test_model_goes_on_where_it_was(tmp_path: Path, folder: Path, trainer: Trainer, degree: int) -> None:
    trainer.train(until=25, progress=False)
    trainer.export_ply(tmp_path / "model.ply")
    scene = load_scene(folder, init_num_pts=50, init_ply=tmp_path / "model.ply")
    again = Trainer(TrainConfig(max_steps=60, sh_degree=degree), scene)
    known = (degree + 1) ** 2 - 1
    model = read_ply(tmp_path / "model.ply")
    order = morton_order(model["means"])
    for name, tensor in model.items():
        expected = tensor[order]
        assert torch.equal(again.splats[name].detach(), expected[:, :known] if name == "shN" else expected), name
    again.train(until=3, progress=False)
    assert torch.equal(scene.gaussians["means"], read_ply(tmp_path / "model.ply")["means"])
