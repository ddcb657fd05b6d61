"""Measurements of the models that other projects' scripts write."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement

from benchmarks import unmodified_scripts
from skipgs_plug.trainer.frame import Frame

NAMES = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
NAMES += ["rot_0", "rot_1", "rot_2", "rot_3", "filter_3D"]


def test_filter_of_mip_splatting_is_taken_into_the_unit_of_the_scene(tmp_path: Path, monkeypatch) -> None:
    vertices = np.zeros(1, [(name, "f4") for name in NAMES])
    vertices["rot_0"], vertices["filter_3D"] = 1.0, 8.0
    for axis in range(3):
        vertices[f"scale_{axis}"] = np.log(6.0)
    PlyData([PlyElement.describe(vertices, "vertex")]).write(tmp_path / "model.ply")
    image = torch.full((2, 2, 3), 128, dtype=torch.uint8)
    view = SimpleNamespace(viewmat=torch.eye(4), K=torch.eye(3), width=2, height=2, image=image)
    scene = SimpleNamespace(frame=Frame((1.0, 2.0, 3.0), 4.0), test=[view], background=(0.0, 0.0, 0.0))
    drawn = {}

    def rasterization(means, quats, scales, opacities, colors, *args, **kwargs):
        drawn.update(scales=scales, opacities=opacities, **kwargs)
        return torch.zeros(1, 2, 2, 3), None, None

    monkeypatch.setattr(unmodified_scripts, "load_scene", lambda path, factor: scene)
    monkeypatch.setattr(unmodified_scripts, "rasterization", rasterization)
    monkeypatch.setattr(unmodified_scripts, "measure", lambda backend, image, photograph: {"psnr": 0.0})
    assert unmodified_scripts.measure_ply(tmp_path / "model.ply", tmp_path, 1)["gaussians"] == 1
    # sqrt(6^2 + 8^2) in units of the dataset, of which four are one unit of the scene.
    assert drawn["scales"].flatten().tolist() == pytest.approx([2.5] * 3)
    assert drawn["opacities"].item() == pytest.approx(0.5 * 0.6**3)
    assert drawn["rasterize_mode"] == "antialiased"
