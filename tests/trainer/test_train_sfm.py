"""`train --sfm` with a stand-in for structure from motion: what is checked before, and what is written at the end."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest
from scene_folders import write_colmap

from skipgs_plug.cli import main
from skipgs_plug.commands import sfm
from skipgs_plug.commands import train as module
from skipgs_plug.trainer import Scene


@pytest.fixture
def photos(tmp_path: Path, tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of photographs, which the stand-in places where they were taken."""
    write_colmap(tiny_scene, tmp_path / "known")
    photos = Path(shutil.copytree(tmp_path / "known/images/cam", tmp_path / "photos"))

    def reconstruct(args: sfm.Args) -> Path:
        return Path(shutil.copytree(tmp_path / "known", args.scene))

    monkeypatch.setattr(sfm, "reconstruct", reconstruct)
    return photos


def train(photos: Path, run: Path, *more: str) -> int:
    return main(["train", str(photos), "--sfm", "--out", str(run), "--max-steps", "4", "--no-progress", *more])


def test_a_model_that_the_small_file_does_not_hold_ends_as_a_finished_run(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    load = module.load_scene

    def far(*arguments: object) -> Scene:
        scene = load(*arguments)
        return dataclasses.replace(scene, frame=dataclasses.replace(scene.frame, centre=(1.6e6, 17.8e6, 300.0)))

    monkeypatch.setattr(module, "load_scene", far)
    assert train(photos, tmp_path / "run") == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("run.spz is left out: A .spz holds coordinates up to 8,388,607, and this model has 17,8")
    assert (tmp_path / "run/ply/point_cloud_3.ply").is_file() and not list(tmp_path.glob("run/*.spz"))
