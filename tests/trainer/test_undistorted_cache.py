"""Undistorted photographs are cached: the same pixels, never outdated, never half written."""

from __future__ import annotations

import errno
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from test_distorted import write_lens

from skipgs_plug.trainer import Scene, load_scene
from skipgs_plug.trainer.loaders import photograph
from skipgs_plug.trainer.loaders.undistorted_cache import FOLDER


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three photographs that differ, as equal ones are kept once."""
    root = write_lens(tmp_path / "scan", "OPENCV")
    for i in range(3):
        with Image.open(root / f"images/view_{i}.png") as opened:
            pixels = np.asarray(opened) // (i + 1)
        Image.fromarray(pixels).save(root / f"images/view_{i}.png")
    return root


@pytest.fixture
def undistorted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the photographs that are undistorted."""
    names, undistort = [], photograph.undistort

    def noted(pixels, mask, camera, image_path):
        names.append(image_path.name)
        return undistort(pixels, mask, camera, image_path)

    monkeypatch.setattr(photograph, "undistort", noted)
    return names


def assert_same(one: Scene, other: Scene) -> None:
    for first, second in zip(one.train, other.train, strict=True):
        assert torch.equal(first.image, second.image) and torch.equal(first.K, second.K)
        assert (first.mask is None) == (second.mask is None)
        assert first.mask is None or torch.equal(first.mask, second.mask)


def test_the_second_load_reads_what_the_first_kept(folder: Path, undistorted: list[str]) -> None:
    first = load_scene(folder, test_every=0)
    assert sorted(undistorted) == ["view_0.png", "view_1.png", "view_2.png"]
    assert first.train[0].mask is not None
    assert_same(first, load_scene(folder, test_every=0))
    assert len(undistorted) == 3 and len(list((folder / FOLDER).iterdir())) == 3
    shutil.rmtree(folder / FOLDER)
    assert_same(first, load_scene(folder, test_every=0))
    assert len(undistorted) == 6


def test_what_it_depends_on_is_seen(folder: Path, undistorted: list[str]) -> None:
    def again() -> list[str]:
        undistorted.clear()
        load_scene(folder, test_every=0)
        return sorted(undistorted)

    assert len(again()) == 3 and again() == []
    picture = folder / "images/view_1.png"
    with Image.open(picture) as opened:
        turned = np.asarray(opened)[::-1]
    Image.fromarray(turned).save(picture)
    assert again() == ["view_1.png"]
    Image.fromarray(np.full((90, 120), 255, dtype=np.uint8)).save(folder / "masks/view_2.png")
    assert again() == ["view_2.png"]
    assert load_scene(folder, test_every=0).train[2].mask.float().mean() > 0.95
    undistorted.clear()
    load_scene(folder, data_factor=2, test_every=0)
    assert len(undistorted) == 3
    cameras = folder / "sparse/0/cameras.txt"
    cameras.write_text(cameras.read_text().replace("-0.15", "-0.14"))
    assert len(again()) == 3


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n garbage", None])
def test_a_damaged_file_is_written_again(folder: Path, undistorted: list[str], content: bytes | None) -> None:
    first = load_scene(folder, test_every=0)
    kept = sorted((folder / FOLDER).iterdir())[0]
    whole = kept.read_bytes()
    kept.write_bytes(whole[: len(whole) // 2] if content is None else content)
    assert_same(first, load_scene(folder, test_every=0))
    assert len(undistorted) == 4 and kept.read_bytes() == whole


def test_a_folder_that_cannot_be_written_is_said_once(
    folder: Path, undistorted: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    (folder / FOLDER).write_text("")  # a file in place of the folder
    first = load_scene(folder, test_every=0)
    assert caplog.text.count("Lens distortion is removed anew at each load") == 1
    (folder / FOLDER).unlink()
    assert_same(first, load_scene(folder, test_every=0))
    assert len(undistorted) == 6


def test_a_full_disk_leaves_nothing_half_written(
    folder: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    save, saved = Image.Image.save, []

    def full(self, target, **options):
        save(self, target, **options)
        saved.append(target)
        if len(saved) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Image.Image, "save", full)
    load_scene(folder, test_every=0)
    assert len(saved) == 2 and len(list((folder / FOLDER).iterdir())) == 1
    assert "No space left" in caplog.text
