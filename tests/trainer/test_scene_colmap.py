"""COLMAP folders are read, and every fault of a folder gives one sentence."""

from __future__ import annotations

import errno
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_folders import write_colmap, write_points

from skipgs_plug.files import WriteError
from skipgs_plug.trainer import InputError, MissingFileError, Scene, load_scene
from skipgs_plug.trainer.loaders import colmap


@pytest.fixture
def folder(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_colmap(tiny_scene, tmp_path / "scan")


@pytest.mark.parametrize("sub", ["sparse/0", "sparse"])
def test_views_points_and_split(tmp_path: Path, tiny_scene: Scene, sub: str) -> None:
    scene = load_scene(write_colmap(tiny_scene, tmp_path / "scan", sub))
    assert [view.name for view in scene.test] == ["cam/view_000.png", "cam/view_008.png"]
    assert [view.name for view in scene.train] == [f"cam/view_00{i}.png" for i in (1, 2, 3, 4, 5, 6, 7, 9)]
    for loaded, made in zip(scene.train, tiny_scene.train, strict=True):
        assert torch.equal(loaded.image, made.image)
        torch.testing.assert_close(loaded.viewmat, made.viewmat, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(loaded.K, made.K)
    torch.testing.assert_close(scene.points, tiny_scene.points)
    assert torch.equal(scene.points_rgb, tiny_scene.points_rgb)
    assert scene.scene_scale == pytest.approx(tiny_scene.scene_scale, rel=1e-5)


def test_intrinsics_follow_the_rounded_size_of_the_image_folder(folder: Path) -> None:
    (folder / "images_2" / "cam").mkdir(parents=True)
    for path in (folder / "images" / "cam").iterdir():
        with Image.open(path) as image:
            image.resize((15, 11)).save(folder / "images_2" / "cam" / (path.stem + ".jpg"))
    full, half = load_scene(folder), load_scene(folder, data_factor=2)
    assert half.train[0].image.shape == (11, 15, 3)
    torch.testing.assert_close(half.train[0].K[0], full.train[0].K[0] * 15 / 32)
    torch.testing.assert_close(half.train[0].K[1], full.train[0].K[1] * 11 / 24)
    assert half.train[0].name == full.train[0].name


def test_missing_factor_folder_is_resized_in_memory_and_said(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = sorted(folder.rglob("*"))
    with caplog.at_level(logging.WARNING):
        scene = load_scene(folder, data_factor=2)
    assert scene.train[0].image.shape == (12, 16, 3)
    assert "images_2 does not exist: resizing" in caplog.text
    assert sorted(folder.rglob("*")) == before


def test_holding_out_none(folder: Path) -> None:
    scene = load_scene(folder, test_every=0)
    assert len(scene.train) == 10 and not scene.test


def test_missing_scene(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"nowhere does not exist; give a COLMAP, nerfstudio"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(MissingFileError, match=r"holds neither .*sparse/0 \(COLMAP\) nor .*transforms_train"):
        load_scene(tmp_path)


def test_missing_model_file(folder: Path) -> None:
    (folder / "sparse/0/images.txt").unlink()
    with pytest.raises(MissingFileError, match=r"Neither .*sparse/0 nor .*sparse holds cameras and images"):
        load_scene(folder)


def test_missing_image(folder: Path) -> None:
    (folder / "images/cam/view_004.png").unlink()
    with pytest.raises(MissingFileError, match=r"Image .*view_004\.png does not exist; restore it"):
        load_scene(folder)


def test_missing_image_folder(folder: Path) -> None:
    (folder / "images").rename(folder / "photographs")
    with pytest.raises(MissingFileError, match=r"Image folder .*images does not exist"):
        load_scene(folder)


def test_damaged_image(folder: Path) -> None:
    path = folder / "images/cam/view_004.png"
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(InputError, match=r"Image .*view_004\.png cannot be decoded .*; replace"):
        load_scene(folder)


def test_damaged_model(folder: Path) -> None:
    (folder / "sparse/0/cameras.txt").write_text("1 NO_SUCH_MODEL 32 24 1 1 1 1\n")
    with pytest.raises(InputError, match=r"COLMAP model .*sparse/0 cannot be read"):
        load_scene(folder)


def test_empty_and_non_finite_points(folder: Path) -> None:
    points = folder / "sparse/0/points3D.txt"
    points.write_text("")
    with pytest.raises(InputError, match=r"sparse/0 has 0 points, but at least 4"):
        load_scene(folder)
    xyz = np.ones((6, 3))
    xyz[2, 1] = np.nan
    write_points(points, xyz, np.zeros((6, 3), dtype=np.uint8))
    with pytest.raises(InputError, match=r"sparse/0 (has 1 points with NaN, infinite|cannot be read)"):
        load_scene(folder)


@pytest.mark.parametrize("name", ["simplify", "tempfile.TemporaryDirectory"])
def test_a_full_temporary_folder_is_not_blamed_on_the_model(
    folder: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    def fail(*given: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(f"{colmap.__name__}.{name}", fail)
    with pytest.raises(
        WriteError, match=r"copy of .*sparse/0 cannot be written \(No space left on device\); set TMPDIR"
    ):
        load_scene(folder)
