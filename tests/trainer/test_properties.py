"""A scene trains alike in every format, and at any position, rotation and size of its world."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from plyfile import PlyData, PlyElement
from scene_folders import write_colmap
from scipy.spatial.transform import Rotation

from skipgs_plug.trainer import Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.packed import save_packed
from skipgs_plug.trainer.ply import read_points
from skipgs_plug.trainer.scene import BLACK, View, assemble_scene


@pytest.fixture(scope="module")
def black(tiny_scene: Scene) -> Scene:
    """As files have it: they know of no background."""
    return dataclasses.replace(tiny_scene, background=BLACK)


def views_of(scene: Scene) -> list[View]:
    return sorted(scene.train + scene.test, key=lambda view: view.name)


def write_text(scene: Scene, root: Path) -> Path:
    return write_colmap(scene, root)


def write_binary(scene: Scene, root: Path) -> Path:
    model = write_colmap(scene, root) / "sparse/0"
    import_pycolmap().Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    return root


def write_cloud(scene: Scene, path: Path) -> None:
    columns = [(name, "f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue")]
    rows = np.empty(len(scene.points), dtype=columns)
    for i, (name, _) in enumerate(columns):
        rows[name] = (scene.points if i < 3 else scene.points_rgb)[:, i % 3].numpy()
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def frames(views: list[View], root: Path, folder: str, suffix: str = ".png") -> list[dict]:
    (root / folder).mkdir(parents=True)
    result = []
    for view in views:
        Image.fromarray(view.image.numpy()).save(root / folder / view.name)
        pose = np.linalg.inv(view.viewmat.numpy()) @ np.diag([1.0, -1.0, -1.0, 1.0])
        path = f"{folder}/{view.name.removesuffix('.png')}{suffix}"
        result.append({"file_path": path, "transform_matrix": pose.tolist()})
    return result


def in_pixels(view: View) -> dict:
    K = view.K.tolist()
    return {"w": view.width, "h": view.height, "fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}


def write_nerfstudio(scene: Scene, root: Path) -> Path:
    """Intrinsics of the file, in pixels."""
    content = {**in_pixels(scene.train[0]), "camera_model": "OPENCV", "ply_file_path": "cloud.ply"}
    content["frames"] = frames(views_of(scene), root, "images")
    write_cloud(scene, root / "cloud.ply")
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def write_nerfstudio_by_frame(scene: Scene, root: Path) -> Path:
    """Intrinsics of each frame, poses of three rows."""
    content = {"ply_file_path": "cloud.ply", "fl_x": 1.0, "frames": frames(views_of(scene), root, "images")}
    for frame, view in zip(content["frames"], views_of(scene), strict=True):
        frame.update(in_pixels(view))
        frame["transform_matrix"] = frame["transform_matrix"][:3]
    write_cloud(scene, root / "cloud.ply")
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def write_instant_ngp(scene: Scene, root: Path) -> Path:
    """Angles of view in degrees; keys that only place the scene in a unit cube."""
    view = scene.train[0]
    fov = [
        math.degrees(2 * math.atan(side / 2 / float(view.K[i, i]))) for i, side in ((0, view.width), (1, view.height))
    ]
    content = {"x_fov": fov[0], "y_fov": fov[1], "aabb_scale": 16, "scale": 0.15, "offset": [0.5, 1.3, 0.2]}
    content |= {"frames": frames(views_of(scene), root, "images"), "ply_file_path": "cloud.ply"}
    write_cloud(scene, root / "cloud.ply")
    (root / "transforms.json").write_text(json.dumps(content))
    return root


def write_blender(scene: Scene, root: Path) -> Path:
    """Angle of view in radians, names without suffix, a file for each part of the split."""
    angle = 2 * math.atan(scene.train[0].width / 2 / float(scene.train[0].K[0, 0]))
    for part, views in (("train", scene.train), ("test", scene.test)):
        content = {
            "camera_angle_x": angle,
            "ply_file_path": "cloud.ply",
            "frames": frames(views, root, part, suffix=""),
        }
        (root / f"transforms_{part}.json").write_text(json.dumps(content))
    write_cloud(scene, root / "cloud.ply")
    return root


def write_packed(scene: Scene, root: Path) -> Path:
    root.mkdir()
    save_packed(scene, root / "scene.npz")
    return root / "scene.npz"


FORMATS = [
    *(write_text, write_binary, write_nerfstudio, write_nerfstudio_by_frame),
    *(write_instant_ngp, write_blender, write_packed),
]


def first_image(scene: Scene) -> torch.Tensor:
    trainer = Trainer(TrainConfig(max_steps=60), scene)
    return trainer.render(scene.train[0])


@pytest.mark.parametrize("write", FORMATS, ids=lambda write: write.__name__.removeprefix("write_"))
def test_every_format_gives_the_same_scene(tmp_path: Path, black: Scene, write) -> None:
    loaded = load_scene(write(black, tmp_path / "scene"))
    for part in ("train", "test"):
        for made, read in zip(getattr(black, part), getattr(loaded, part), strict=True):
            assert read.viewmat.dtype == read.K.dtype == torch.float64
            torch.testing.assert_close(read.viewmat, made.viewmat, rtol=0, atol=1e-9)
            torch.testing.assert_close(read.K, made.K, rtol=0, atol=1e-9)
            assert torch.equal(read.image, made.image)
    assert torch.equal(loaded.points, black.points)
    assert torch.equal(loaded.points_rgb, black.points_rgb)
    assert loaded.scene_scale == pytest.approx(black.scene_scale, rel=1e-9)
    torch.testing.assert_close(first_image(loaded), first_image(black), rtol=0, atol=1e-5)


def moved(scene: Scene, rotation: np.ndarray, shift: np.ndarray, scale: float) -> Scene:
    """Return the scene in a world of positions scale * rotation @ x + shift."""

    def move(view: View) -> View:
        pose = view.viewmat.numpy()
        turned = pose[:3, :3] @ rotation.T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = turned, scale * pose[:3, 3] - turned @ shift
        return dataclasses.replace(view, viewmat=torch.from_numpy(viewmat))

    train, test = ([move(view) for view in views] for views in (scene.train, scene.test))
    points = scale * scene.points.double().numpy() @ rotation.T + shift
    return assemble_scene(Path("x"), "x", train, test, points, scene.points_rgb.numpy(), scene.background)


def rotation_of(seed: int) -> np.ndarray:
    return Rotation.random(random_state=seed).as_matrix()


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**31),
    shift=st.tuples(*[st.floats(-1e7, 1e7)] * 3),
    exponent=st.floats(-6, 7),
)
def test_the_first_image_does_not_depend_on_the_world(black: Scene, seed: int, shift, exponent: float) -> None:
    scale = 10.0**exponent
    other = moved(black, rotation_of(seed), scale * np.array(shift), scale)
    difference = (first_image(other) - first_image(black)).abs()
    assert float(difference.mean()) < 2e-5
    assert float(difference.max()) < 5e-3  # the bound allows a Gaussian near the threshold of visibility


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_run_does_not_depend_on_the_world(tiny_scene: Scene, seed: int) -> None:
    def psnr(scene: Scene) -> float:
        trainer = Trainer(TrainConfig(max_steps=60, refine_start_iter=30_000, sh_degree_interval=5000), scene)
        trainer.train(progress=False)
        return trainer.evaluate()["psnr"]

    other = moved(tiny_scene, rotation_of(seed), np.array([5e5, -4.5e6, 120.0]), 3.0)
    # Adam steps along the axes, so a rotated scene takes other steps of the same length.
    assert psnr(other) == pytest.approx(psnr(tiny_scene), abs=0.15)


NAMES = ["x", "y", "z", "red", "green", "blue", "nx", "quality"]


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    order=st.permutations(NAMES),
    places=st.lists(st.sampled_from(["i1", "i2", "i4", "f4", "f8"]), min_size=3, max_size=3),
    colours=st.sampled_from(["u1", "i2", "u2", "i4", "u4", "f4", "f8"]),
    form=st.sampled_from(["<", ">", "text"]),
)
def test_any_order_and_type_of_the_columns_of_a_cloud(tmp_path: Path, order, places, colours, form: str) -> None:
    kinds = dict(zip(NAMES, [*places, colours, colours, colours, "f4", "u1"], strict=True))
    values = np.random.default_rng(0).integers(-100, 100, (20, 3))
    rgb = np.random.default_rng(1).integers(0, 256, (20, 3))
    rgb[0] = 255
    rows = np.zeros(20, dtype=[(name, kinds[name]) for name in order])
    for i, name in enumerate(NAMES[:6]):
        rows[name] = (values if i < 3 else rgb)[:, i % 3]
    text = form == "text"
    data = PlyData([PlyElement.describe(rows, "vertex")], text=text, byte_order="=" if text else form)
    data.write(str(tmp_path / "cloud.ply"))
    positions, colour = read_points(tmp_path / "cloud.ply")
    np.testing.assert_array_equal(positions, values)
    np.testing.assert_array_equal(colour, rgb)
