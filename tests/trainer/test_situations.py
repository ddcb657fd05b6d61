"""Inputs that users of neighbouring tools met; SITUATIONS.md lists their sources."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData, PlyElement
from scene_folders import write_blender, write_colmap

from skipgs_plug.cli import main
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.loaders.camera_keys import read_camera, values_of
from skipgs_plug.trainer.metrics import psnr
from skipgs_plug.trainer.ply import PROPERTIES, read_ply, read_points, read_start, write_ply


@pytest.fixture
def colmap(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_colmap(tiny_scene, tmp_path / "scene")


def rename_images(root: Path, rename) -> None:
    file = root / "sparse/0/images.txt"
    lines = []
    for line in file.read_text().splitlines():
        if line:
            *fields, name = line.split(maxsplit=9)
            new = rename(name)
            target = root / "images" / new
            target.parent.mkdir(parents=True, exist_ok=True)
            (root / "images" / name).rename(target)
            line = " ".join([*fields, new])
        lines.append(line)
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def names(scene: Scene) -> list[str]:
    return sorted(view.name for view in scene.train + scene.test)


def test_names_with_spaces_and_beyond_ascii(colmap: Path) -> None:
    rename_images(colmap, lambda name: f"Plan  A (ä)/{Path(name).name} 1 2 3.png")
    scene = load_scene(colmap)
    assert len(names(scene)) == 10
    assert names(scene)[0] == "Plan  A (ä)/view_000.png 1 2 3.png"


@pytest.mark.parametrize("eol", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("second", [None, "", "1.5 2.5 -1 3 4 7", "10 1 0 5 0 3 0 2 -1"])
def test_text_models_of_other_programs(colmap: Path, eol: str, encoding: str, second: str | None) -> None:
    """Second lines may be missing, empty, or hold observations that look like poses."""
    folder = colmap / "sparse/0"
    images = [line for line in (folder / "images.txt").read_text().splitlines() if line]
    lines = ["# comment"] + [line for image in images for line in ([image] if second is None else [image, second])]
    (folder / "images.txt").write_bytes((eol.join(lines) + eol).encode(encoding))
    cameras = (folder / "cameras.txt").read_text().splitlines()
    (folder / "cameras.txt").write_bytes((eol.join(["# comment", *cameras]) + eol).encode(encoding))
    assert len(names(load_scene(colmap))) == 10


def test_a_name_of_digits_is_no_observation(colmap: Path) -> None:
    # A line of images.txt with the name "000" has ten fields.
    rename_images(colmap, lambda name: name.split("_")[1].removesuffix(".png"))
    file = colmap / "sparse/0/images.txt"
    file.write_text("\n".join(line for line in file.read_text().splitlines() if line))
    for image in (colmap / "images").glob("0*"):
        image.rename(image.with_name(f"{image.name}.png"))
    assert len(names(load_scene(colmap))) == 10


def test_the_larger_model_is_named_and_taken(colmap: Path, caplog: pytest.LogCaptureFixture) -> None:
    whole = (colmap / "sparse/0/images.txt").read_text()
    (colmap / "sparse/1").mkdir()
    for name in ("cameras.txt", "points3D.txt", "images.txt"):
        (colmap / "sparse/1" / name).write_text((colmap / "sparse/0" / name).read_text())
    (colmap / "sparse/0/images.txt").write_text("\n".join(whole.splitlines()[:6]) + "\n")
    assert len(names(load_scene(colmap))) == 3
    assert f"{colmap / 'sparse/1'} has 10" in caplog.text
    assert len(names(load_scene(colmap / "sparse/1"))) == 10


@pytest.mark.parametrize("kind", ["colmap", "blender"])
def test_a_cloud_in_place_of_no_points(tmp_path: Path, tiny_scene: Scene, kind: str) -> None:
    if kind == "colmap":
        root = write_colmap(tiny_scene, tmp_path / "scene")
        (root / "sparse/0/points3D.txt").write_text("")
        with pytest.raises(InputError, match=r"has 0 points.*--init-ply"):
            load_scene(root)
    else:
        root = write_blender(tiny_scene, tmp_path / "scene")
    write_columns(tmp_path / "cloud.ply", {name: np.arange(8.0) for name in "xyz"})
    scene = load_scene(root, init_ply=tmp_path / "cloud.ply")
    assert scene.points[:, 0].tolist() == pytest.approx(range(8), abs=1e-6)


def write_nerf(scene: Scene, root: Path, **changes) -> Path:
    write_blender(scene, root)
    content = json.loads((root / "transforms_train.json").read_text())
    for name in ("transforms_train.json", "transforms_test.json"):
        (root / name).unlink()
    for frame in content["frames"]:
        frame["file_path"] += ".png"
    write_columns(root / "points.ply", {name: np.arange(8.0) for name in "xyz"})
    (root / "transforms.json").write_text(json.dumps({**content, "ply_file_path": "points.ply", **changes}))
    return root


@pytest.mark.parametrize("way", ["backslashes", "absolute", "./"])
def test_paths_of_frames(tmp_path: Path, tiny_scene: Scene, way: str) -> None:
    root = write_nerf(tiny_scene, tmp_path / "scene")
    expected = names(load_scene(root))
    content = json.loads((root / "transforms.json").read_text())
    for frame in content["frames"]:
        path = frame["file_path"].removeprefix("./")
        frame["file_path"] = {"backslashes": path.replace("/", "\\"), "absolute": str(root / path), "./": f"./{path}"}[
            way
        ]
    (root / "transforms.json").write_text(json.dumps(content))
    assert names(load_scene(root)) == expected


KEYS = [
    ({"fl_x": 50}, "PINHOLE", [50, 50, 40, 30]),
    ({"fl_y": 50}, "PINHOLE", [50, 50, 40, 30]),
    ({"camera_angle_y": math.pi / 2}, "PINHOLE", [30, 30, 40, 30]),
    ({"camera_angle_x": math.pi / 2, "camera_angle_y": math.pi / 2}, "PINHOLE", [40, 30, 40, 30]),
    ({"x_fov": 90}, "PINHOLE", [40, 40, 40, 30]),
    ({"y_fov": 90}, "PINHOLE", [30, 30, 40, 30]),
    ({"camera_angle_x": math.pi / 2, "fl_y": 44, "cx": 41, "cy": 29}, "PINHOLE", [40, 44, 41, 29]),
    ({"fl_x": 50, "is_fisheye": True, "k1": 0.1}, "OPENCV_FISHEYE", [50, 50, 40, 30, 0.1, 0, 0, 0]),
    ({"fl_x": 50, "is_fisheye": False, "k1": 0.1}, "OPENCV", [50, 50, 40, 30, 0.1, 0, 0, 0]),
    ({"fl_x": 50, "camera_model": "OPENCV_FISHEYE"}, "OPENCV_FISHEYE", [50, 50, 40, 30, 0, 0, 0, 0]),
]


@pytest.mark.parametrize(("keys", "model", "parameters"), KEYS)
def test_camera_keys(keys: dict, model: str, parameters: list[float]) -> None:
    camera = read_camera({"w": 80, "h": 60, **keys}, Path("x.png"), Path("transforms.json"))
    assert camera.model.name == model
    np.testing.assert_allclose(camera.params, parameters, atol=1e-9)


def test_a_frame_has_the_last_word_about_its_lens() -> None:
    """A frame's focal length replaces the file's, by whichever keys they give it."""
    file = {"w": 80, "h": 60, "fl_x": 50.0, "fl_y": 50.0, "k1": 0.0}
    for own, focal in (
        ({"camera_angle_x": 2 * math.atan(0.5)}, 80.0),
        ({"y_fov": 90.0}, 30.0),
        ({"fl_y": 70.0}, 70.0),
        ({"fl_x": None, "cx": 1.0}, 50.0),
    ):
        camera = read_camera(values_of(file, own), Path("x.png"), Path("transforms.json"))
        assert camera.params[:2] == pytest.approx([focal, focal], abs=1e-9)


@pytest.mark.parametrize(
    "keys",
    [
        *({"rolling_shutter": [0, 0, 0.1, 0]}, {"latlong": True}, {"ftheta_p1": 0.3}, {"b1": 2.0}, {"k5": 0.1}),
        *({"white_transparent": True}, {"mask_color": "0x00ff00"}, {"from_mitsuba": True}),
    ],
)
def test_keys_that_change_the_picture_are_refused(keys: dict) -> None:
    with pytest.raises(InputError, match=f"{next(iter(keys))} is .*not supported"):
        read_camera({"w": 80, "h": 60, "fl_x": 50, **keys}, Path("x.png"), Path("transforms.json"))


def test_blender_file_with_intrinsics_and_points(tmp_path: Path, tiny_scene: Scene) -> None:
    root = write_blender(tiny_scene, tmp_path / "scene")
    write_columns(root / "points.ply", {name: np.arange(8.0) for name in "xyz"})
    file = root / "transforms_train.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "cx": 15.0, "cy": 10.0, "fl_y": 33.0, "ply_file_path": "points.ply"}))
    scene = load_scene(root)
    assert len(scene.points) == 8
    assert scene.train[0].K[:2, 2].tolist() == [15, 10]
    assert scene.train[0].K[1, 1] == 33
    half = load_scene(root, data_factor=2).train[0].K
    np.testing.assert_allclose(half[:2], scene.train[0].K[:2] / 2, rtol=1e-6)


def write_columns(path: Path, columns: dict[str, np.ndarray]) -> None:
    rows = np.empty(len(next(iter(columns.values()))), dtype=[(name, v.dtype) for name, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


NAMES_OF_COLOURS = [
    ("red", "green", "blue"),
    ("r", "g", "b"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("Red", "Green", "Blue"),
]


@pytest.mark.parametrize("triple", NAMES_OF_COLOURS)
@pytest.mark.parametrize(
    ("kind", "factor"), [("u1", 1), ("u2", 257), ("u2", 1), ("i4", 1), ("f4", 1), ("f4", 1 / 255), ("f8", 1 / 255)]
)
def test_colours_of_any_name_and_type(tmp_path: Path, triple, kind: str, factor: float) -> None:
    colours = np.array([[255, 0, 10], [20, 200, 30], [40, 50, 60], [1, 2, 3]])
    xyz = {name: np.arange(4, dtype="f8") + i for i, name in enumerate("xyz")}
    own = {name: (colours[:, i] * factor).astype(kind) for i, name in enumerate(triple)}
    write_columns(tmp_path / "cloud.ply", dict(reversed([*xyz.items(), *own.items()])))
    np.testing.assert_array_equal(read_points(tmp_path / "cloud.ply")[1], colours)


def test_colours_a_little_too_bright_and_bytes_with_a_sign(tmp_path: Path) -> None:
    xyz = {name: np.arange(4, dtype="f4") for name in "xyz"}
    white = {name: np.array([1.0005, 0.5, 0.0, 1.0], dtype="f4") for name in ("red", "green", "blue")}
    write_columns(tmp_path / "bright.ply", {**xyz, **white})
    assert read_points(tmp_path / "bright.ply")[1][:, 0].tolist() == [255, 128, 0, 255]
    signed = {name: np.array([-1, -128, 127, 0], dtype="i1") for name in ("red", "green", "blue")}
    write_columns(tmp_path / "signed.ply", {**xyz, **signed})
    assert read_points(tmp_path / "signed.ply")[1][:, 2].tolist() == [255, 128, 127, 0]


def test_packed_and_missing_colours(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    xyz = {name: np.arange(4, dtype="f4") for name in "xyz"}
    bits = np.array([0xFF0A14, 0x000001, 0xC80000, 0x00FF00], dtype="u4")
    for packed in (bits, bits.view("f4")):
        write_columns(tmp_path / "pcl.ply", {**xyz, "rgb": packed})
        assert read_points(tmp_path / "pcl.ply")[1].tolist() == [[255, 10, 20], [0, 0, 1], [200, 0, 0], [0, 255, 0]]
    assert not caplog.text
    write_columns(tmp_path / "bare.ply", xyz)
    assert (read_points(tmp_path / "bare.ply")[1] == 128).all()
    assert "has no colours" in caplog.text


def gaussians(degree: int, n: int = 600) -> dict[str, torch.Tensor]:
    torch.manual_seed(1)
    return {
        "means": torch.randn(n, 3),
        "scales": torch.randn(n, 3) - 3,
        "quats": torch.nn.functional.normalize(torch.randn(n, 4), dim=1),
        "opacities": torch.randn(n),
        "sh0": torch.randn(n, 1, 3),
        "shN": torch.randn(n, (degree + 1) ** 2 - 1, 3) / 4,
    }


def write_model(path: Path, splats: dict[str, torch.Tensor], kinds: str = "<f4", reverse: bool = False) -> None:
    """Write a 3DGS PLY with as many f_rest columns as the degree has."""
    n, rest = len(splats["means"]), splats["shN"].shape[1]
    columns = {name: splats["means"][:, i] for i, name in enumerate("xyz")}
    columns |= {f"f_dc_{i}": splats["sh0"][:, 0, i] for i in range(3)}
    columns |= {f"f_rest_{i}": column for i, column in enumerate(splats["shN"].mT.reshape(n, 3 * rest).T)}
    columns |= {"opacity": splats["opacities"]} | {f"scale_{i}": splats["scales"][:, i] for i in range(3)}
    columns |= {f"rot_{i}": splats["quats"][:, i] for i in range(4)}
    items = list(columns.items())
    write_columns(path, {name: v.numpy().astype(kinds) for name, v in (reversed(items) if reverse else items)})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize(("kinds", "reverse"), [("<f4", False), (">f4", True), ("<f8", True)])
def test_models_of_any_degree_order_and_type(tmp_path: Path, degree: int, kinds: str, reverse: bool) -> None:
    splats = gaussians(degree)
    write_model(tmp_path / "model.ply", splats, kinds, reverse)
    for name, values in read_ply(tmp_path / "model.ply").items():
        assert torch.equal(values, splats[name]), name
    for ending in (".splat", ".compressed.ply", ".ply"):
        assert main(["export", str(tmp_path / "model.ply"), str(tmp_path / f"out{ending}")]) == 0
    assert torch.equal(read_ply(tmp_path / "out.ply")["means"], splats["means"])


def test_a_compressed_model_is_read(tmp_path: Path) -> None:
    splats = gaussians(3)
    splats["opacities"] = splats["opacities"].clamp(-3, 3)
    write_model(tmp_path / "model.ply", splats)
    assert main(["export", str(tmp_path / "model.ply"), str(tmp_path / "x.compressed.ply")]) == 0
    read = read_ply(tmp_path / "x.compressed.ply")
    distance = torch.cdist(read["means"], splats["means"])
    assert float(distance.min(dim=1).values.max()) < 0.01
    same = distance.argmin(dim=1)
    assert len(set(same.tolist())) == 600
    turned = (read["quats"] * splats["quats"][same]).sum(dim=1).abs()
    assert float(turned.min()) > 0.9999
    for name, error in (("scales", 0.01), ("sh0", 0.03), ("shN", 0.04)):
        assert float((read[name] - splats[name][same]).abs().max()) < error, name
    alpha = torch.sigmoid(read["opacities"]) - torch.sigmoid(splats["opacities"][same])
    assert float(alpha.abs().max()) < 0.003
    assert main(["export", str(tmp_path / "x.compressed.ply"), str(tmp_path / "y.ply")]) == 0
    with pytest.raises(InputError, match=r"is compressed: .*export .*x\.ply"):
        read_start(tmp_path / "x.compressed.ply")


def test_saturated_values_are_clamped_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    splats = gaussians(1)
    splats["opacities"][3], splats["opacities"][4], splats["scales"][5, 2] = math.inf, -math.inf, -math.inf
    write_model(tmp_path / "model.ply", splats)
    read = read_ply(tmp_path / "model.ply")
    assert "2 infinite opacities are read" in caplog.text
    assert "1 infinite scales are read" in caplog.text
    assert torch.sigmoid(read["opacities"][3]) == 1
    assert all(bool(torch.isfinite(values).all()) for values in read.values())
    write_ply(splats, tmp_path / "again.ply")
    assert set(PlyData.read(tmp_path / "again.ply")["vertex"].data.dtype.names) == set(PROPERTIES)
    assert torch.equal(read_ply(tmp_path / "again.ply")["opacities"], read["opacities"])
    splats["means"][0, 0] = math.nan
    write_ply(splats, tmp_path / "nan.ply")  # the file is written, so that the run is not lost
    with pytest.raises(InputError, match="NaN"):
        read_ply(tmp_path / "nan.ply")


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
@pytest.mark.parametrize(
    "settings", [{}, {"strategy": "mcmc", "cap_max": 200}, {"exposure": True, "random_bkgd": True}]
)
def test_any_default_type(opaque_scene: Scene, dtype: torch.dtype, settings: dict) -> None:
    runs = []
    for default in (torch.float32, dtype):
        torch.set_default_dtype(default)
        try:
            trainer = Trainer(TrainConfig(max_steps=60, refine_every=4, **settings), opaque_scene)
            trainer.train(progress=False)
            runs.append(trainer.evaluate()["psnr"])
            assert torch.get_default_dtype() == default
        finally:
            torch.set_default_dtype(torch.float32)
    assert runs[0] == pytest.approx(runs[1], abs=0.01)


def test_one_photograph_names_the_option(colmap: Path) -> None:
    file = colmap / "sparse/0/images.txt"
    file.write_text(file.read_text().splitlines()[0] + "\n\n")
    with pytest.raises(InputError, match="--test-every 0"):
        load_scene(colmap)
    assert len(load_scene(colmap, test_every=0).train) == 1


def test_equal_images_have_a_finite_psnr() -> None:
    image = torch.rand(8, 8, 3)
    assert psnr(image, image) == 100.0


def test_what_a_fisheye_loses_is_said(tmp_path: Path, tiny_scene: Scene, caplog: pytest.LogCaptureFixture) -> None:
    """A lens of 180 degrees cannot be a pinhole whole."""
    fisheye = {"camera_model": "OPENCV_FISHEYE", "w": 32, "h": 24, "fl_x": 32 / math.pi, "fl_y": 32 / math.pi}
    load_scene(write_nerf(tiny_scene, tmp_path / "scene", **fisheye))
    assert "of about 180 degrees" in caplog.text


@pytest.mark.parametrize("sizes", [(2.5, 2.5, 2.5), (1.0, 3.0, 0.2)])
def test_the_size_of_a_camera_object_changes_nothing(tmp_path: Path, tiny_scene: Scene, sizes) -> None:
    root = write_nerf(tiny_scene, tmp_path / "scene")
    expected = load_scene(root)
    turn_frames(root, lambda pose: pose @ np.diag([*sizes, 1.0]))
    for first, second in zip(load_scene(root).train, expected.train, strict=True):
        torch.testing.assert_close(first.viewmat, second.viewmat, rtol=0, atol=1e-12)


def test_mirrored_and_sheared_cameras_are_refused(tmp_path: Path, tiny_scene: Scene) -> None:
    root = write_nerf(tiny_scene, tmp_path / "scene")
    shear = np.eye(4)
    shear[0, 1] = 0.2
    for change, said in ((np.diag([1.0, 1.0, -1.0, 1.0]), "mirror image"), (shear, "not at right angles")):
        turn_frames(root, lambda pose, change=change: pose @ change)
        with pytest.raises(InputError, match=said):
            load_scene(root)
        turn_frames(root, lambda pose, change=change: pose @ np.linalg.inv(change))


def turn_frames(root: Path, change) -> None:
    content = json.loads((root / "transforms.json").read_text())
    for frame in content["frames"]:
        frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()
    (root / "transforms.json").write_text(json.dumps(content))
