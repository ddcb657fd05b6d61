"""Scenes far from the origin and in odd units train as they would at the origin, and files are where they were."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from plyfile import PlyData
from scene_folders import write_colmap

from skipgs_plug.cli import main
from skipgs_plug.trainer import InputError, Scene, TrainConfig, Trainer, load_scene
from skipgs_plug.trainer.errors import DamagedCheckpointError
from skipgs_plug.trainer.frame import Frame
from skipgs_plug.trainer.loaders.packed import save_packed
from skipgs_plug.trainer.ply import read_ply, write_ply
from skipgs_plug.trainer.scene import View, assemble_scene
from skipgs_plug.view.gaussians import to_gaussians
from skipgs_plug.view.model import open_model

UTM = (500_000.0, 4_500_000.0, 120.0)
NOWHERE = (0.0, 0.0, 0.0)


def placed(scene: Scene, unit: float, shift: tuple[float, float, float]) -> Scene:
    """Return the scene with positions unit * x + shift."""

    def move(view: View) -> View:
        pose = view.viewmat.double().clone()
        pose[:3, 3] = unit * pose[:3, 3] - pose[:3, :3] @ torch.tensor(shift, dtype=torch.float64)
        return dataclasses.replace(view, viewmat=pose)

    train, test = ([move(view) for view in views] for views in (scene.train, scene.test))
    points = scene.points.double().numpy() * unit + np.array(shift)
    return assemble_scene(Path("x"), "x", train, test, points, scene.points_rgb.numpy(), scene.background)


def trained(scene: Scene, **settings) -> Trainer:
    trainer = Trainer(TrainConfig(**{"max_steps": 60, "sh_degree_interval": 5000, **settings}), scene)
    trainer.train(progress=False)
    return trainer


def assert_same_run(first: Trainer, second: Trainer) -> None:
    """To the last bit: the number of Gaussians, each parameter, and each moment."""
    for name, param in first.splats.items():
        assert torch.equal(param, second.splats[name]), name
        state, other = (trainer.optimizers[name].state[trainer.splats[name]] for trainer in (first, second))
        for key in ("exp_avg", "exp_avg_sq"):
            assert torch.equal(state[key], other[key]), (name, key)


DENSIFYING = {"refine_every": 8, "grow_grad2d": 5e-5}
WORLDS = [
    *((10.0**exponent, NOWHERE) for exponent in (-6, -5, -4, -3, 4, 7)),
    *((2.0**exponent, NOWHERE) for exponent in (-20, 23)),
    *((0.3048, NOWHERE), (1.0, (1.0, -2.0, 3.0)), (0.01, (20.0, 0.0, 5.0))),
]


@pytest.mark.parametrize("settings", [DENSIFYING, {"strategy": "mcmc", "cap_max": 160}], ids=["default", "mcmc"])
def test_unit_and_place_of_a_scene_change_no_bit(tiny_scene: Scene, settings: dict) -> None:
    expected = trained(placed(tiny_scene, 1.0, NOWHERE), **settings)
    if settings is DENSIFYING:
        assert expected.num_gaussians > 160
    for unit, shift in WORLDS:
        assert_same_run(expected, trained(placed(tiny_scene, unit, shift), **settings))


@pytest.mark.parametrize("shift", [UTM, (1e7, 0, 0), (0, -3e3, 0)])
@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e5])
def test_far_from_the_origin_inputs_are_rounded_and_no_more(tiny_scene: Scene, shift, unit: float) -> None:
    """Doubles hold a place on a map to about a nanometre. Without densification that stays small."""
    settings = {"refine_start_iter": 30_000}
    expected = trained(placed(tiny_scene, 1.0, NOWHERE), **settings)
    found = trained(placed(tiny_scene, unit, tuple(unit * value for value in shift)), **settings)
    assert found.evaluate()["psnr"] == pytest.approx(expected.evaluate()["psnr"], abs=0.05)


def test_lengths_that_the_user_gives_are_of_the_dataset(tiny_scene: Scene) -> None:
    expected = trained(placed(tiny_scene, 1.0, NOWHERE), near_plane=0.5, far_plane=20.0)
    found = trained(placed(tiny_scene, 2.0**-10, NOWHERE), near_plane=0.5 * 2.0**-10, far_plane=20.0 * 2.0**-10)
    assert_same_run(expected, found)


def test_cameras_in_one_place_have_the_extent_of_what_they_see(tiny_scene: Scene) -> None:
    """A panorama head, or one photograph: rounding of the poses must not become the size of the scene."""

    def turned(noise: float) -> Scene:
        views = []
        for i, view in enumerate(tiny_scene.train):
            pose = view.viewmat.double().clone()
            pose[:3, 3] = noise * (-1.0) ** i
            views.append(dataclasses.replace(view, viewmat=pose))
        return assemble_scene(Path("x"), "x", views, [], tiny_scene.points.numpy(), tiny_scene.points_rgb.numpy())

    still, rounded = turned(0.0), turned(1e-12)
    assert still.scene_scale == rounded.scene_scale
    assert still.frame.is_like(rounded.frame, 1.0)
    depth = tiny_scene.frame.unit * float(tiny_scene.points.norm(dim=1).median())
    assert 0.2 * depth < still.frame.unit < 5 * depth


def test_splats_and_poses_go_there_and_back() -> None:
    frame = Frame(UTM, 2.0**-12)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-499_999.0, -4_500_003.0, -118.0])
    torch.testing.assert_close(frame.dataset_pose(frame.local_pose(pose)), pose, rtol=0, atol=1e-8)
    splats = {"means": torch.randn(5, 3), "scales": torch.randn(5, 3)}
    there = frame.dataset_splats(splats)
    assert there["means"].dtype == torch.float64
    back = frame.local_splats(there)
    torch.testing.assert_close(back, splats, rtol=0, atol=1e-5)


def test_a_run_at_utm_coordinates_is_written_there(tmp_path: Path, tiny_scene: Scene, caplog) -> None:
    root = write_colmap(tiny_scene, tmp_path / "scene")
    move_text_model(root, UTM)
    run = tmp_path / "run"
    length = ["--max-steps", "30", "--no-progress", "--refine-every", "4"]
    assert main(["train", str(root), "--out", str(run), "--gate", *length]) == 0
    said = json.loads((run / "skipgs.json").read_text())["frame"]
    assert np.abs(np.array(said["centre"]) - UTM).max() < 10
    (ply,) = (run / "ply").glob("*.ply")
    vertices = PlyData.read(ply)["vertex"]
    assert vertices["x"].dtype == np.float64
    assert vertices["opacity"].dtype == np.float32
    middle = np.median([vertices["x"], vertices["y"], vertices["z"]], axis=1)
    assert np.abs(middle - UTM).max() < 5
    # Checkpoint, PLY with its scene, and exported PLY hold the same model.
    assert main(["export", str(run), str(tmp_path / "out.ply")]) == 0
    torch.testing.assert_close(read_ply(tmp_path / "out.ply")["means"], read_ply(ply)["means"], rtol=0, atol=1e-6)
    of_run, of_ply = open_model(run), open_model(ply, scene=str(root))
    own, other = of_run.load(of_run.snapshots[-1]), of_ply.load(of_ply.snapshots[-1])
    for name in ("means", "scales"):
        torch.testing.assert_close(own[name], other[name], rtol=0, atol=1e-5)
    assert float(own["means"].abs().median()) < 5
    # --init-ply starts from the same Gaussians, and a resumed run continues.
    again = load_scene(root, init_ply=ply)
    torch.testing.assert_close(again.gaussians["means"], own["means"], rtol=0, atol=1e-5)
    assert main(["train", str(root), "--out", str(run), "--resume", "--gate", *length[:1], "40", *length[2:]]) == 0
    assert main(["export", str(run), str(tmp_path / "out.splat")]) == 0
    assert "positions are rounded by up to 0.27 units" in caplog.text
    # A packed scene has the same cameras and points.
    save_packed(load_scene(root), tmp_path / "packed.npz")
    packed, loaded = load_scene(tmp_path / "packed.npz"), load_scene(root)
    for first, second in zip(packed.train, loaded.train, strict=True):
        torch.testing.assert_close(first.viewmat, second.viewmat, rtol=0, atol=1e-5)
    torch.testing.assert_close(packed.points, loaded.points, rtol=0, atol=1e-5)


def move_text_model(root: Path, shift: tuple[float, float, float]) -> None:
    from scipy.spatial.transform import Rotation

    images = root / "sparse/0/images.txt"
    lines = []
    for line in images.read_text().splitlines():
        if line:
            fields = line.split(maxsplit=9)
            w, x, y, z, *t = (float(value) for value in fields[1:8])
            moved = np.array(t) - Rotation.from_quat([x, y, z, w]).as_matrix() @ np.array(shift)
            line = " ".join([*fields[:5], *(repr(float(value)) for value in moved), *fields[8:]])
        lines.append(line)
    images.write_text("\n".join(lines) + "\n")
    points = root / "sparse/0/points3D.txt"
    rows = [line.split() for line in points.read_text().splitlines()]
    for row in rows:
        row[1:4] = [repr(float(value) + by) for value, by in zip(row[1:4], shift, strict=True)]
    points.write_text("\n".join(" ".join(row) for row in rows) + "\n")


def utm_model(path: Path, n: int = 400) -> dict[str, torch.Tensor]:
    """Write a PLY of a model in coordinates of a map; return it as it would be at the origin."""
    generator = torch.Generator().manual_seed(0)
    local = {
        "means": torch.randn(n, 3, generator=generator, dtype=torch.float64),
        "scales": torch.randn(n, 3, generator=generator) / 4 - 4,
        "quats": torch.nn.functional.normalize(torch.randn(n, 4, generator=generator), dim=1),
        "opacities": torch.randn(n, generator=generator),
        "sh0": torch.randn(n, 1, 3, generator=generator),
        "shN": torch.randn(n, 15, 3, generator=generator) / 8,
    }
    local["means"][0] = torch.tensor([900.0, 0, 0])  # one Gaussian is far off
    write_ply({**local, "means": local["means"] + torch.tensor(UTM, dtype=torch.float64)}, path)
    return local


def test_a_model_of_a_map_is_shown_without_its_scene(tmp_path: Path) -> None:
    local = utm_model(tmp_path / "model.ply")
    model = open_model(tmp_path / "model.ply")
    shown = model.load(model.snapshots[-1])
    assert shown["means"].dtype == torch.float32
    middle = torch.from_numpy(np.median(local["means"].numpy(), axis=0))
    torch.testing.assert_close(shown["means"].double(), local["means"] - middle, rtol=0, atol=1e-4)
    for name in ("scales", "quats", "opacities", "sh0", "shN"):
        torch.testing.assert_close(shown[name], local[name])
    on_page = to_gaussians(shown, 1.0)
    assert np.abs(np.median(on_page.centers, axis=0)).max() < 0.01
    # If the model were not moved, float32 would have steps of half a unit.
    assert len(np.unique(on_page.centers[:, 1].round(3))) > 350
    # All snapshots of a model move by the same amount.
    assert torch.equal(model.load(model.snapshots[-1])["means"], shown["means"])


def test_a_model_at_the_origin_stays(tmp_path: Path, tiny_scene: Scene) -> None:
    trained(tiny_scene).export_ply(tmp_path / "model.ply")
    model = open_model(tmp_path / "model.ply")
    assert torch.equal(model.load(model.snapshots[-1])["means"], read_ply(tmp_path / "model.ply")["means"])


def test_resuming_compares_coordinates_and_poses(tmp_path: Path, tiny_scene: Scene) -> None:
    begun = trained(placed(tiny_scene, 1.0, UTM))
    begun.save_checkpoint(tmp_path / "c.pt")

    def resume(scene: Scene) -> None:
        Trainer(TrainConfig(max_steps=60, sh_degree_interval=5000), scene).load_checkpoint(tmp_path / "c.pt")

    resume(placed(tiny_scene, 1.0, UTM))
    resume(placed(tiny_scene, 1.0, tuple(value + 1e-7 for value in UTM)))  # the same poses, rounded differently
    for unit, shift in ((1.0, NOWHERE), (1.0, (500_010.0, *UTM[1:])), (1e-3, UTM)):
        with pytest.raises(InputError, match="but the frame of the scene is now"):
            resume(placed(tiny_scene, unit, shift))
    other = placed(tiny_scene, 1.0, UTM)
    other.train[2].viewmat[:3, 3] += 0.01
    with pytest.raises(InputError, match=r"other poses of 1 of its 8 cameras, such as 'view_003\.png'"):
        resume(other)
    content = torch.load(tmp_path / "c.pt", weights_only=True)
    content["scene"]["centre"] = "here"
    torch.save(content, tmp_path / "c.pt")
    with pytest.raises(DamagedCheckpointError):
        resume(other)


def test_a_checkpoint_in_coordinates_of_the_dataset_goes_on(tmp_path: Path, tiny_scene: Scene) -> None:
    """As of version 0.1.0, which knew no others, and no poses."""
    scene = placed(tiny_scene, 0.25, (3.0, -1.0, 2.0))
    begun = trained(scene, **DENSIFYING)
    begun.save_checkpoint(tmp_path / "now.pt")
    content = torch.load(tmp_path / "now.pt", weights_only=True)
    unit = scene.frame.unit
    content["splats"] = {name: tensor.float() for name, tensor in scene.frame.dataset_splats(content["splats"]).items()}
    content["optimizers"]["means"]["exp_avg"] /= unit
    content["optimizers"]["means"]["exp_avg_sq"] /= unit**2
    content["strategy"]["scene_scale"] *= unit
    poses = torch.stack([scene.frame.dataset_pose(view.viewmat) for view in scene.train])
    for more in ({}, {"viewmats": poses}):
        content["scene"] = {**{name: content["scene"][name] for name in ("name", "view_names")}, **more}
        torch.save(content, tmp_path / "before.pt")
        resumed = Trainer(begun.config, scene)
        resumed.load_checkpoint(tmp_path / "before.pt")
        for name, param in begun.splats.items():
            torch.testing.assert_close(resumed.splats[name], param, rtol=1e-5, atol=1e-6)
        own, theirs = (t.optimizers["means"].state[t.splats["means"]] for t in (resumed, begun))
        for key in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(own[key], theirs[key], rtol=1e-5, atol=0)
        assert resumed.strategy_state["scene_scale"] == scene.scene_scale
    content["scene"]["viewmats"] = poses + 0.01
    torch.save(content, tmp_path / "before.pt")
    with pytest.raises(InputError, match="other poses of 8 of its 8 cameras"):
        Trainer(begun.config, scene).load_checkpoint(tmp_path / "before.pt")


def test_photographs_of_another_size_do_not_go_on(tiny_scene, tmp_path):
    begun = trained(tiny_scene)
    begun.save_checkpoint(tmp_path / "now.pt")
    content = torch.load(tmp_path / "now.pt", weights_only=True)
    width, height = content["scene"]["sizes"][2].tolist()
    content["scene"]["sizes"][2] *= 2
    torch.save(content, tmp_path / "before.pt")
    sentence = rf"another size: 'view_\d+.png' had {2 * width}x{2 * height} pixels, and has {width}x{height}; resume"
    with pytest.raises(InputError, match=sentence):
        Trainer(begun.config, tiny_scene).load_checkpoint(tmp_path / "before.pt")
