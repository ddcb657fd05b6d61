"""Films and pictures of a run, and of a PLY alone."""

from __future__ import annotations

import sys

import imageio.v3 as iio
import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from skipgs_plug.cli import main
from skipgs_plug.trainer import TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.ply import read_ply
from skipgs_plug.view.draw import Painter, colour_depth, depth_range
from skipgs_plug.view.model import open_model
from skipgs_plug.view.path import camera_path

# imageio-ffmpeg does not close the pipes of a finished encoder; the garbage collector does.
LEAVES_PIPES = "ignore:unclosed file:ResourceWarning"


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_a_film_along_the_path(run_folder, tmp_path, capsys):
    film = tmp_path / "film.mp4"
    command = ["render", str(run_folder), str(film), "--frames", "7", "--fps", "5", "--show", "both", "--no-progress"]
    assert main(command) == 0
    assert "7 frames" in capsys.readouterr().out
    frames = iio.imread(film, plugin="FFMPEG")
    assert frames.shape == (7, 24, 66, 3)
    assert iio.immeta(film, plugin="FFMPEG")["fps"] == 5
    assert [path.name for path in tmp_path.iterdir()] == ["film.mp4"]
    assert np.abs(frames[0].astype(float) - frames[-1]).mean() > 2  # the camera moves


@pytest.mark.parametrize(
    ("module", "sentence"),
    [("imageio_ffmpeg", "needs the package imageio_ffmpeg; run: "), ("warp", "Backend warp needs NVIDIA Warp")],
)
def test_a_missing_package_is_one_sentence(module, sentence, run_folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, module, None)
    command = ["render", str(run_folder), str(tmp_path / "film.mp4"), "--backend", "warp", "--no-progress"]
    assert main(command) == 2
    error = capsys.readouterr().err
    assert sentence in error and "pip install" in error and error.count("\n") == 1
    assert not any(tmp_path.iterdir())


def test_a_backend_that_cannot_render_is_refused_before_the_model_is_opened(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "warp", None)
    assert main(["render", str(tmp_path / "no_such_run"), str(tmp_path / "film.mp4"), "--backend", "warp"]) == 2
    assert "Backend warp needs NVIDIA Warp" in capsys.readouterr().err


def test_held_out_pictures_are_what_the_trainer_renders(run_folder, scene_file, tmp_path):
    out = tmp_path / "held_out"
    assert main(["render", str(run_folder), str(out), "--cameras", "held-out", "--no-progress"]) == 0
    scene = load_scene(scene_file)
    names = sorted(path.name for path in out.iterdir())
    assert len(names) == len(scene.test) == 2
    for i, view in enumerate(scene.test):
        with Image.open(run_folder / f"renders/val_step39_{i:04d}.png") as both:
            expected = np.asarray(both)[:, view.width :]
        with Image.open(out / view.name) as picture:
            assert np.abs(np.asarray(picture).astype(int) - expected).max() <= 1


def test_a_ply_needs_a_scene_and_may_lack_normals(ply, scene_file, tmp_path, capsys):
    out = tmp_path / "pictures"
    assert main(["render", str(ply), str(out)]) == 2
    assert "add --scene" in capsys.readouterr().err
    vertices = PlyData.read(str(ply))["vertex"].data
    kept = [name for name in vertices.dtype.names if name not in ("nx", "ny", "nz")]
    without = np.empty(len(vertices), dtype=[(name, "<f4") for name in kept])
    for name in kept:
        without[name] = vertices[name]
    short = tmp_path / "short.ply"
    PlyData([PlyElement.describe(without, "vertex")]).write(str(short))
    pictures = []
    for i, path in enumerate((ply, short)):
        command = ["render", str(path), str(tmp_path / str(i)), "--scene", str(scene_file), "--frames", "2"]
        assert main([*command, "--no-progress"]) == 0
        with Image.open(tmp_path / str(i) / "frame_0001.png") as picture:
            pictures.append(np.asarray(picture))
    assert np.array_equal(*pictures) and pictures[0].std() > 5


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("nowhere", "out"), "nowhere does not exist"),
        (("{empty}", "out"), "holds no model"),
        (("{run}", "film.gif"), "is neither a film (.mp4) nor a folder"),
        (("{run}/gone", "film.gif"), "is neither a film (.mp4) nor a folder"),  # before a scene is read
        (("{run}", "{run}"), "not an empty folder"),
        (("{run}", "out", "--frames", "0"), "--frames 0 is too small"),
        (("{run}", "out.mp4", "--fps", "1001"), "--fps 1001 is too large"),
        (("{run}", "out", "--data-factor", "0"), "data_factor=0 is not an integer in 1..64"),
        (("{run}", "out", "--scene", "gone"), "Scene gone does not exist"),
    ],
)
def test_bad_input_is_one_sentence(run_folder, tmp_path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    filled = [argument.format(run=run_folder, empty=tmp_path / "empty") for argument in arguments]
    assert main(["render", *filled, "--no-progress"]) == 2
    error = capsys.readouterr().err
    assert sentence in error and len(error.splitlines()) == 1


def test_a_run_whose_scene_has_gone_says_so(run_folder, tmp_path, capsys):
    (tmp_path / "ply").mkdir()
    (tmp_path / "ply/point_cloud_39.ply").write_bytes((run_folder / "ply/point_cloud_39.ply").read_bytes())
    (tmp_path / "cfg.yml").write_text("data_dir: /gone/scene\n")
    assert main(["render", str(tmp_path), str(tmp_path / "out")]) == 2
    assert "was trained on /gone/scene, which does not exist here; add --scene" in capsys.readouterr().err


def test_a_model_is_shown_with_the_settings_of_its_training(scene_file, ply, tmp_path, monkeypatch):
    """Also from another folder than that in which it was trained."""
    monkeypatch.chdir(scene_file.parent)
    options = ["--near-plane", "0.3", "--far-plane", "90", "--exposure", "--init-ply", str(ply)]
    assert main(["train", scene_file.name, "--out", str(tmp_path / "run"), "--max-steps", "3", *options]) == 0
    monkeypatch.chdir(tmp_path)
    model = open_model(tmp_path / "run")
    planes = [plane * model.scene.frame.unit for plane in (model.near_plane, model.far_plane)]
    assert planes == pytest.approx([0.3, 90.0])
    assert (model.exposure, model.antialiased) == (True, False)
    assert len(model.scene.points) == len(read_ply(ply)["means"])
    alone, with_scene = open_model(ply), open_model(ply, str(scene_file))
    assert alone.near_plane == 0.01 and not with_scene.exposure
    assert with_scene.near_plane == Trainer(TrainConfig(), load_scene(scene_file)).near_plane


def test_only_what_lies_between_the_planes_is_drawn(scene_file):
    view = load_scene(scene_file).train[0]
    pose = torch.linalg.inv(view.viewmat)
    splats = {
        "means": (pose[:3, 3] + 0.2 * pose[:3, 2])[None].float(),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), -3.0),
        "opacities": torch.full((1,), 5.0),
        "sh0": torch.ones(1, 1, 3),
        "shN": torch.zeros(1, 0, 3),
    }
    drawn = []
    for near, far in ((0.01, 1e10), (0.3, 1e10), (0.01, 0.1)):
        painter = Painter(resolve_backend("warp"), (0.0, 0.0, 0.0), near, antialiased=False, far_plane=far)
        drawn.append(float(painter.draw(splats, view.viewmat, view.K, view.width, view.height)[0].max()))
    assert drawn[0] > 0.5 and drawn[1:] == [0, 0]


def test_the_path_begins_and_ends_at_the_views_and_moves_evenly(scene_file):
    views = load_scene(scene_file).train
    poses = camera_path(views, 101)
    assert torch.allclose(poses[0], views[0].viewmat, atol=1e-5)
    assert torch.allclose(poses[-1], views[-1].viewmat, atol=1e-5)
    assert torch.allclose(poses[:, :3, :3] @ poses[:, :3, :3].mT, torch.eye(3).double().expand(101, 3, 3), atol=1e-5)
    worlds = torch.linalg.inv(poses)
    turns = (worlds[1:, :3, :3].mT @ worlds[:-1, :3, :3]).diagonal(dim1=1, dim2=2).sum(1)
    steps = (worlds[1:, :3, 3] - worlds[:-1, :3, 3]).norm(dim=1)
    assert steps.max() < 4 * steps.mean() and turns.min() > 2.5  # the path does not jump
    single = camera_path(views[:1] * 2, 3)
    assert torch.allclose(single, views[0].viewmat.expand(3, 4, 4), atol=1e-5)


def test_colours_of_depth():
    depth = torch.tensor([[0.0, 2.0], [3.0, 4.0]])
    low, high = depth_range([depth])
    assert 2.0 <= low < high <= 4.0
    colours = colour_depth(depth, (2.0, 4.0))
    assert colours[0, 0].tolist() == [0, 0, 0]
    assert colours[0, 1, 0] > colours[0, 1, 2] and colours[1, 1, 2] > colours[1, 1, 1]  # near is red, far is blue
    assert depth_range([torch.zeros(2, 2)]) == (0.0, 1.0)


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_a_film_that_cannot_be_written_is_one_sentence(run_folder, tmp_path, capfd):
    (tmp_path / "file").write_text("")
    film = tmp_path / "file/film.mp4"
    assert main(["render", str(run_folder), str(film), "--frames", "2", "--no-progress"]) == 2
    assert capfd.readouterr().err.splitlines() == [
        f"skipgs-plug: {film} cannot be written (File exists): {tmp_path / 'file'} is a file, not a folder; "
        "give another path."
    ]


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_a_film_that_does_not_fit_is_one_sentence(run_folder, tmp_path, capfd):
    resource = pytest.importorskip("resource")
    film, limits = tmp_path / "film.mp4", resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))  # the encoder inherits the limit
    try:
        assert main(["render", str(run_folder), str(film), "--frames", "60", "--no-progress"]) == 2
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    said = [line for line in capfd.readouterr().err.splitlines() if line.startswith("skipgs-plug: ")]
    assert len(said) == 1 and said[0].startswith(f"skipgs-plug: {film} cannot be written (the encoder ended early")
    assert not list(tmp_path.iterdir())
