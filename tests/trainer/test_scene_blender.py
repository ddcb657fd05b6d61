"""Blender folders: axes, transparency, focal length, errors."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from scene_folders import write_blender

from skipgs_plug.trainer import InputError, MissingFileError, Scene, load_scene


@pytest.fixture
def folder(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_blender(tiny_scene, tmp_path / "toy")


def test_cameras_and_white_background(folder: Path, tiny_scene: Scene) -> None:
    scene = load_scene(folder, init_num_pts=50)
    assert scene.background == (1.0, 1.0, 1.0)
    assert [view.name for view in scene.test] == ["test/view_000.png", "test/view_008.png"]
    for loaded, made in zip(scene.train, tiny_scene.train, strict=True):
        torch.testing.assert_close(loaded.viewmat, made.viewmat, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(loaded.K, made.K)
        assert (loaded.image[:, :16] == 255).all()
        assert torch.equal(loaded.image[:, 16:], made.image[:, 16:])
    assert scene.points.shape == (50, 3) and scene.points.abs().max() <= 1.3


def test_factor_and_own_split(folder: Path) -> None:
    (folder / "transforms_test.json").unlink()
    scene = load_scene(folder, data_factor=2, test_every=4, init_num_pts=50)
    assert len(scene.test) == 2 and len(scene.train) == 6
    assert scene.train[0].image.shape == (12, 16, 3)
    assert float(scene.train[0].K[0, 2]) == 8.0


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda c: c.pop("camera_angle_x"), r"has neither fl_x nor camera_angle_x nor x_fov"),
        (lambda c: c.update(camera_angle_x=10**400), r"camera_angle_x is 1000.*\.\.\., not a finite number"),
        (lambda c: c.update(camera_angle_x=0.0), r"camera_angle_x is 0, not between 0 and pi"),
        (lambda c: c.update(frames=[1]), r"lists no frames"),
        (lambda c: c["frames"][0].update(file_path=3), r"file_path of a frame is 3, not a string"),
        (lambda c: c["frames"][0].update(transform_matrix=[[10**400] * 4] * 4), r"is not 4x4 numbers"),
        (lambda c: c["frames"][0].update(transform_matrix=[[0.0] * 4] * 4), r"not a finite pose"),
        (lambda c: c["frames"].clear(), r"lists no frames"),
        (lambda c: c["frames"][0].update(transform_matrix=[[1.0]]), r"is not 4x4"),
        (lambda c: c["frames"][0]["transform_matrix"][0].__setitem__(0, float("nan")), r"not a finite pose"),
    ],
)
def test_bad_transforms(folder: Path, change, sentence: str) -> None:
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"transforms_train\.json.*" + sentence):
        load_scene(folder)


def test_invalid_json_and_missing_image(folder: Path) -> None:
    (folder / "train/view_001.png").unlink()
    with pytest.raises(MissingFileError, match=r"view_001\.png does not exist"):
        load_scene(folder)
    for content in (b"{", b"[" * 100_000, b'{"a": ' + b"9" * 5000 + b"}", b"\xff\xfe", b""):
        (folder / "transforms_train.json").write_bytes(content)
        with pytest.raises(InputError, match=r"transforms_train\.json is not valid JSON"):
            load_scene(folder)
    (folder / "transforms_train.json").write_text("[]")
    with pytest.raises(InputError, match="holds no JSON object"):
        load_scene(folder)


@pytest.mark.parametrize(
    "name", ["train/r_0.5", "train/r_0.5.png", "train/view", "train/view.png", "train/view.v2.jpg"]
)
def test_suffix_is_found(folder: Path, name: str) -> None:
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = name
    path.write_text(json.dumps(content))
    file = name if name.endswith((".png", ".jpg")) else name + ".png"
    (folder / "train/view_001.png").rename(folder / file)
    assert file in [view.name for view in load_scene(folder).train]


@pytest.mark.parametrize("name", ["../secret.png", "/etc/x.png", "a/../../x.png", "C:\\x.png", "..\\x.png"])
def test_names_that_leave_the_scene(folder: Path, name: str) -> None:
    (folder.parent / "secret.png").write_bytes((folder / "train/view_001.png").read_bytes())
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"leaves the scene"):
        load_scene(folder)


@pytest.mark.parametrize("name", ["a\0b.png", "a\udc80.png", "x" * 5000 + ".png"])
def test_names_that_no_file_has(folder: Path, name: str) -> None:
    path = folder / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][0]["file_path"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=r"control characters or is not UTF-8|does not exist"):
        load_scene(folder)
