"""Distorted cameras against an analytic picture, in which a ray's colour depends on its direction alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from skipgs_plug.trainer import InputError, MissingFileError, Scene, View, load_scene
from skipgs_plug.trainer.loaders.native import import_pycolmap

WIDTH, HEIGHT = 120, 90
PINHOLE = (100.0, 98.0, 61.0, 44.0)
LENSES = {  # parameters of COLMAP's camera models
    "SIMPLE_RADIAL": (100.0, 61.0, 44.0, 0.1),
    "OPENCV": (*PINHOLE, -0.15, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (*PINHOLE, -0.15, 0.03, 0.002, -0.003, 0.01, 0.0, 0.0, 0.0),
    "OPENCV_FISHEYE": (*PINHOLE, 0.05, -0.01, 0.0, 0.0),
}


def picture(rays: np.ndarray) -> np.ndarray:
    """Colour [..., 3] of normalised image coordinates [..., 2], smooth and different everywhere."""
    x, y = rays[..., 0], rays[..., 1]
    return np.stack([0.5 + 0.7 * x, 0.5 + 0.8 * y, 0.5 + 0.3 * np.sin(6 * x) * np.cos(5 * y)], axis=-1).clip(0, 1)


def right_half(rays: np.ndarray) -> np.ndarray:
    return rays[..., 0] > 0.05


def distorted_rays(model: str, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    camera = import_pycolmap().Camera({"model": model, "width": WIDTH, "height": HEIGHT, "params": LENSES[model]})
    camera.rescale(width, height)
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.array(camera.cam_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))).reshape(height, width, 2)


def pinhole_rays(view: View) -> np.ndarray:
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    K = view.K.numpy()
    return np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1]], axis=-1)


@pytest.mark.parametrize("model", LENSES)
def test_the_lenses_of_these_tests_distort(model: str) -> None:
    straight = View("", torch.zeros(HEIGHT, WIDTH, 3), torch.tensor(
        [[100.0, 0, 61], [0, 98 if len(LENSES[model]) > 4 else 100, 44], [0, 0, 1]]), torch.eye(4))  # fmt: skip
    assert np.abs(picture(pinhole_rays(straight)) - picture(distorted_rays(model))).max() * 255 > 6


def save(values: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.rint(values * 255).astype(np.uint8)).save(path)


def write_lens(root: Path, model: str) -> Path:
    """Write a COLMAP folder with three views through one lens, and a mask for the first."""
    for i in range(3):
        save(picture(distorted_rays(model)), root / f"images/view_{i}.png")
    save(right_half(distorted_rays(model)).astype(float), root / "masks/view_0.png")
    sparse = root / "sparse/0"
    sparse.mkdir(parents=True)
    parameters = " ".join(map(str, LENSES[model]))
    (sparse / "cameras.txt").write_text(f"1 {model} {WIDTH} {HEIGHT} {parameters}\n")
    (sparse / "images.txt").write_text("".join(f"{i + 1} 1 0 0 0 {i} 0 0 1 view_{i}.png\n\n" for i in range(3)))
    (sparse / "points3D.txt").write_text("".join(f"{i + 1} {i} 0 {i} 9 9 9 0.5\n" for i in range(5)))
    return root


def assert_straight(view: View) -> None:
    expected = picture(pinhole_rays(view)) * 255
    assert np.abs(view.image.numpy() - expected).max() < 3  # of 255: rounded, distorted, sampled and rounded again
    assert view.width > 80 and view.height > 60


@pytest.mark.parametrize("model", LENSES)
def test_colmap(tmp_path: Path, model: str, caplog: pytest.LogCaptureFixture) -> None:
    folder = write_lens(tmp_path / "scan", model)
    scene = load_scene(folder, test_every=0)
    for view in scene.train:
        assert_straight(view)
    assert f"lens distortion ({model}) is removed" in caplog.text
    mask = scene.train[0].mask
    assert mask is not None and scene.train[1].mask is None
    wrong = mask.numpy() != right_half(pinhole_rays(scene.train[0]))
    assert wrong.mean() < 0.01  # only pixels at the edge differ


def test_no_pinhole_sees_a_sphere(tmp_path: Path) -> None:
    folder = write_lens(tmp_path / "scan", "OPENCV")
    (folder / "sparse/0/cameras.txt").write_text(f"1 EQUIRECTANGULAR {WIDTH} {HEIGHT} {WIDTH} {HEIGHT}\n")
    with pytest.raises(InputError, match=r"EQUIRECTANGULAR, cannot be undistorted|cannot be read"):
        load_scene(folder)


@pytest.mark.parametrize("k1", [5.0, -5.0])
def test_absurd_lenses_end_in_a_sentence_or_a_picture(tmp_path: Path, k1: float) -> None:
    folder = write_lens(tmp_path / "scan", "OPENCV")
    (folder / "sparse/0/cameras.txt").write_text(f"1 OPENCV {WIDTH} {HEIGHT} 100 98 61 44 {k1} 0 0 0\n")
    try:
        view = load_scene(folder, test_every=0).train[1]
    except InputError:
        return
    assert min(view.width, view.height) >= 11 and view.K.isfinite().all()


def test_smaller_copies_scale_the_lens(tmp_path: Path) -> None:
    folder = write_lens(tmp_path / "scan", "OPENCV")
    half = load_scene(folder, data_factor=2, test_every=0).train[1]
    assert half.width < 70 and np.abs(half.image.numpy() - picture(pinhole_rays(half)) * 255).max() < 6
    for i in range(3):
        save(picture(distorted_rays("OPENCV", 60, 45)), folder / f"images_2/view_{i}.png")
    half = load_scene(folder, data_factor=2, test_every=0).train[1]
    assert half.width < 70 and np.abs(half.image.numpy() - picture(pinhole_rays(half)) * 255).max() < 4


def write_nerfstudio(root: Path, model: str = "OPENCV", **more: object) -> Path:
    """Write transforms.json with three views through one lens, a mask for the first and a point cloud."""
    for i in range(3):
        save(picture(distorted_rays(model)), root / f"images/frame_{i}.png")
    save(right_half(distorted_rays(model)).astype(float), root / "masks/frame_0.png")
    xyz = np.array([(i, 0, i, 10 * i, 0, 255) for i in range(5)], dtype=float)
    kinds = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    table = np.array([tuple(row) for row in xyz], dtype=kinds)
    PlyData([PlyElement.describe(table, "vertex")]).write(str(root / "sparse_pc.ply"))
    names = (
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        *(("k1", "k2", "k3", "k4") if "FISHEYE" in model else ("k1", "k2", "p1", "p2")),
    )
    poses = [np.eye(4) for _ in range(3)]
    for i, pose in enumerate(poses):
        pose[:3, 3] = (i, 2, 3)
    frames = [{"file_path": f"./images/frame_{i}.png", "transform_matrix": p.tolist()} for i, p in enumerate(poses)]
    frames[0]["mask_path"] = "masks/frame_0.png"
    content = {"w": WIDTH, "h": HEIGHT, "camera_model": model, "ply_file_path": "sparse_pc.ply", "frames": frames}
    content.update(zip(names, LENSES[model], strict=False))
    if model == "FULL_OPENCV":
        content["k3"] = LENSES[model][8]
    (root / "transforms.json").write_text(json.dumps({**content, **more}))
    return root


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"])
def test_nerfstudio(tmp_path: Path, model: str) -> None:
    scene = load_scene(write_nerfstudio(tmp_path / "ns", model), test_every=0)
    assert [view.name for view in scene.train] == [f"images/frame_{i}.png" for i in range(3)]
    for i, view in enumerate(scene.train):
        assert_straight(view)
        # OpenGL cameras look along -z with y up; cameras of a Scene look along +z with y down.
        torch.testing.assert_close(scene.frame.dataset_pose(view.viewmat), torch.tensor(
            [[1.0, 0, 0, -i], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]]).double())  # fmt: skip
    assert scene.train[0].mask is not None and scene.train[1].mask is None
    place = scene.points[4].numpy() * scene.frame.unit + scene.frame.centre
    assert place.tolist() == pytest.approx([4, 0, 4], abs=1e-5) and scene.points_rgb[4].tolist() == [40, 0, 255]


def test_nerfstudio_pinhole_by_angle_split_and_factor(tmp_path: Path) -> None:
    split = {"train_filenames": ["images/frame_0.png", "./images/frame_2.png"], "val_filenames": ["images/frame_1.png"]}
    lens = dict.fromkeys(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"))
    folder = write_nerfstudio(
        tmp_path / "ns", w=None, h=None, camera_angle_x=0.9, camera_model="PINHOLE", **lens, **split
    )
    scene = load_scene(folder)
    assert [view.name for view in scene.test] == ["images/frame_1.png"] and len(scene.train) == 2
    focal = 60 / np.tan(0.45)
    torch.testing.assert_close(scene.test[0].K, torch.tensor([[focal, 0, 60], [0, focal, 45], [0, 0, 1]]).double())
    for i in range(3):
        save(picture(distorted_rays("OPENCV", 60, 45)), folder / f"images_2/frame_{i}.png")
    half = load_scene(folder, data_factor=2).test[0]
    assert half.image.shape == (45, 60, 3) and half.name == "images/frame_1.png"
    torch.testing.assert_close(half.K[:2], scene.test[0].K[:2] / 2)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, r"camera_model 'EQUIRECTANGULAR' is not supported, only PERSPECTIVE"),
        ({"k4": 0.1}, r"camera_model 'OPENCV' with k4 is not supported"),
        ({"fl_x": None, "fl_y": None}, r"has neither fl_x nor camera_angle_x"),
        ({"fl_x": -5}, r"has a focal length of -5"),
        ({"fl_x": 0}, r"focal length of 0"),
        ({"fl_x": "wide"}, r"fl_x is 'wide', not a finite number"),
        ({"w": 0}, r"w and h are 0 and 90"),
        (
            {"w": None, "h": None, "cx": 500.0},
            r"cx and cy lie outside frame_.* and w and h are missing; add the w and h",
        ),
        ({"w": 90}, r"but its camera is 90x90"),
        ({"frames": []}, r"lists no frames"),
        ({"ply_file_path": "../x.ply"}, r"leaves the scene"),
        ({"ply_file_path": 3}, r"ply_file_path is 3, not a string"),
        ({"ply_file_path": "none.ply"}, r"none\.ply does not exist"),
        ({"train_filenames": ["images/frame_7.png"]}, r"its split names 'images/frame_7\.png', which is not a frame"),
        ({"train_filenames": 7}, r"train_filenames is not a list"),
    ],
)
def test_nerfstudio_refusals(tmp_path: Path, change: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        load_scene(write_nerfstudio(tmp_path / "ns", **change), test_every=0)


def test_nerfstudio_without_a_cloud(tmp_path: Path) -> None:
    folder = write_nerfstudio(tmp_path / "ns", ply_file_path=None)
    cloud = (folder / "sparse_pc.ply").rename(tmp_path / "cloud.ply")
    with pytest.raises(InputError, match=r"names no ply_file_path; .* or give --init-ply"):
        load_scene(folder)
    scene: Scene = load_scene(folder, init_ply=cloud)
    assert len(scene.points) == 5 and scene.gaussians is None
    with pytest.raises(MissingFileError, match=r"nothing\.ply does not exist"):
        load_scene(folder, init_ply=tmp_path / "nothing.ply")
