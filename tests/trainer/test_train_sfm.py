"""`train --sfm` with a stand-in for structure from motion: what is checked before, and what is written at the end."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from pathlib import Path

import pytest
import torch
from scene_folders import write_colmap

from skipgs_plug.cli import main
from skipgs_plug.commands import sfm
from skipgs_plug.commands import train as module
from skipgs_plug.photos.origin import FILE, origin_of, write_origin
from skipgs_plug.trainer import Scene


@pytest.fixture
def photos(tmp_path: Path, tiny_scene: Scene, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of photographs, which the stand-in places where they were taken."""
    write_colmap(tiny_scene, tmp_path / "known")
    photos = Path(shutil.copytree(tmp_path / "known/images/cam", tmp_path / "photos"))

    def reconstruct(args: sfm.Args) -> None:
        shutil.copytree(tmp_path / "known", args.scene)
        write_origin(origin_of(args.photos), args.scene)
        print("Reconstructed.")

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
    *_, left_out, last = capsys.readouterr().out.splitlines()
    assert left_out.startswith("run.spz is left out: A .spz holds coordinates up to 8,388,607, and this model has 17,8")
    assert last.startswith("Next: ") and "share it" not in last
    assert (tmp_path / "run/ply/point_cloud_3.ply").is_file() and not list(tmp_path.glob("run/*.spz"))


@pytest.fixture
def stopped(photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    """A run folder with the scene of the photographs and no checkpoint, as if the run was killed while it trained."""
    run = tmp_path / "run"
    assert train(photos, run) == 0 and "Reconstructed." in capsys.readouterr().out
    for name in ("ckpts", "ply", "stats", "renders"):
        shutil.rmtree(run / name)
    return run


def test_a_repeated_command_uses_the_scene_again_and_says_so(
    photos: Path, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(photos, stopped) == 0
    shown = capsys.readouterr().out
    assert f"{stopped / 'scene'} is used again, made of {photos}.\n" in shown and "Reconstructed." not in shown


def test_the_scene_of_an_older_version_is_used_again(
    photos: Path, stopped: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (stopped / "scene" / FILE).unlink()
    assert train(photos, stopped) == 0
    assert "scene is used again, which does not say what it was made of.\n" in capsys.readouterr().out


def test_the_scene_of_other_photographs_is_refused(
    photos: Path, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Path(shutil.copytree(photos, tmp_path / "other"))
    max(other.iterdir()).unlink()
    assert train(other, stopped) == 2
    error, scene = capsys.readouterr().err, stopped / "scene"
    assert f"{scene} was made of {photos}, not of {other}; give another --out, or delete {scene}" in error
    assert error.count("\n") == 1 and not (stopped / "ckpts").exists()
    shutil.rmtree(scene)  # as the sentence says
    assert train(other, stopped) == 0


def test_the_scene_of_photographs_that_were_moved_is_used_again(
    photos: Path, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(photos.rename(tmp_path / "moved"), stopped) == 0
    assert "Reconstructed." not in capsys.readouterr().out


@pytest.mark.parametrize("change", ["added", "removed", "replaced"])
def test_the_scene_of_photographs_that_have_changed_is_refused(
    photos: Path, stopped: Path, capsys: pytest.CaptureFixture[str], change: str
) -> None:
    first = min(photos.iterdir())
    if change == "added":
        shutil.copy(first, photos / "one_more.png")
    elif change == "removed":
        first.unlink()
    else:
        first.write_bytes(first.read_bytes() + b"\0")
    assert train(photos, stopped) == 2
    error = capsys.readouterr().err
    assert f"{photos} has changed since {stopped / 'scene'} was made of it (files that differ: 1); give" in error


def test_a_run_is_resumed_although_photographs_were_added(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert train(photos, tmp_path / "run") == 0
    shutil.copy(min(photos.iterdir()), photos / "one_more.png")
    assert train(photos, tmp_path / "run", "--resume", "--max-steps", "6") == 0
    shown = capsys.readouterr().out
    assert f"is used again, made of {photos}." in shown and shown.count("Reconstructed.") == 1


def test_photographs_are_not_mapped_for_a_run_that_another_scene_began(
    photos: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    assert train(photos, run) == 0
    shutil.rmtree(run / "scene")
    assert train(photos, run, "--resume") == 2
    captured = capsys.readouterr()
    assert "without --sfm" in captured.err and captured.out.count("Reconstructed.") == 1
    assert not (run / "scene").exists()


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (["--init-ply", "nothing.ply"], "nothing.ply does not exist"),
        (["--test-every", "1"], "photos leaves no training view: every view is held out. Give --test-every 0"),
        (["--backend", "gsplat"], "Backend gsplat needs a CUDA device"),
        (["--view"], "This command needs the package viser"),
        (["--tensorboard"], "This command needs the package tensorboard"),
    ],
)
def test_what_training_would_refuse_is_refused_before_structure_from_motion(
    photos: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    options: list[str],
    sentence: str,
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    for package in ("viser", "tensorboard"):
        monkeypatch.setitem(sys.modules, package, None)  # as if it was not installed
    assert train(photos, tmp_path / "run", *options) == 2
    captured = capsys.readouterr()
    assert sentence in captured.err and captured.err.count("\n") == 1 and "Reconstructed." not in captured.out
    assert not (tmp_path / "run").exists()
