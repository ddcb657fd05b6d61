"""Binary models: counts are checked against lengths before pycolmap believes them, values afterwards."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch
from scene_folders import write_colmap

from skipgs_plug.trainer import InputError, Scene, load_scene
from skipgs_plug.trainer.loaders.native import import_pycolmap

FILES = ("cameras.bin", "images.bin", "points3D.bin")


@pytest.fixture
def folder(tmp_path: Path, tiny_scene: Scene) -> Path:
    root = write_colmap(tiny_scene, tmp_path / "scan")
    model = root / "sparse/0"
    import_pycolmap().Reconstruction(str(model)).write_binary(str(model))
    for path in model.glob("*.txt"):
        path.unlink()
    return root


def patch(path: Path, offset: int, kind: str, *values: float) -> None:
    content = bytearray(path.read_bytes())
    struct.pack_into(kind, content, offset, *values)
    path.write_bytes(content)


def test_binary_is_read_as_text(folder: Path, tiny_scene: Scene) -> None:
    scene = load_scene(folder)
    for loaded, made in zip(scene.train, tiny_scene.train, strict=True):
        assert torch.equal(loaded.image, made.image) and loaded.mask is None
        torch.testing.assert_close(loaded.viewmat, made.viewmat, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(scene.points, tiny_scene.points)


@pytest.mark.parametrize("name", [*FILES, "rigs.bin", "frames.bin"])
def test_cut_and_longer_files(folder: Path, name: str) -> None:
    path = folder / "sparse/0" / name
    if not path.is_file():
        pytest.skip("this version of pycolmap does not write it")
    whole = path.read_bytes()
    for cut in {1, 7, len(whole) // 100 + 1, len(whole) // 2, len(whole) - 8, len(whole) - 3, len(whole)}:
        path.write_bytes(whole[: len(whole) - cut])
        with pytest.raises(InputError, match=rf"{name} ends early: its counts do not fit"):
            load_scene(folder)
    path.write_bytes(whole + b"\0" * 5)
    with pytest.raises(InputError, match=rf"{name} has 5 bytes too many"):
        load_scene(folder)


@pytest.mark.parametrize("count", [2**31, 2**40, 2**63, 2**64 - 1])
@pytest.mark.parametrize("name", FILES)
def test_counts_that_no_file_holds(folder: Path, name: str, count: int) -> None:
    patch(folder / "sparse/0" / name, 0, "<Q", count)
    with pytest.raises(InputError, match=rf"{name} ends early"):
        load_scene(folder)
    if name == "points3D.bin":  # it also counts the elements of each track
        patch(folder / "sparse/0" / name, 0, "<Q", 160)
        patch(folder / "sparse/0" / name, 8 + 43, "<Q", count)
        with pytest.raises(InputError, match=rf"{name} ends early"):
            load_scene(folder)


@pytest.mark.parametrize(
    ("offset", "kind", "value", "sentence"),
    [
        (12, "<i", 99, r"camera of unknown model 99"),
        (16, "<Q", 0, r"has a size of 0x24"),
        (16, "<Q", 2**60, r"has a size of 1152921504606846976x24"),
        (32, "<d", 0.0, r"has a focal length of 0"),
        (32, "<d", -30.0, r"has a focal length of -30"),
        (32, "<d", np.nan, r"has parameters \[nan"),
        (48, "<d", np.inf, r"has parameters"),
        (24, "<Q", 32, r"is 32x24, but its camera is 32x32"),
    ],
)
def test_camera_values(folder: Path, offset: int, kind: str, value: float, sentence: str) -> None:
    patch(folder / "sparse/0/cameras.bin", offset, kind, value)
    with pytest.raises(InputError, match=sentence):
        load_scene(folder)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_rotations_that_are_none(folder: Path, value: float) -> None:
    patch(folder / "sparse/0/images.bin", 12, "<4d", *[value] * 4)
    frames = folder / "sparse/0/frames.bin"
    if frames.is_file():  # newer versions read the pose from frames.bin
        patch(frames, 16, "<4d", *[value] * 4)
    with pytest.raises(InputError, match=r"sparse/0: the pose of '.*' is not valid|cannot be read"):
        load_scene(folder)


@pytest.mark.parametrize("name", [b"../../view01.png", b"/etc/passwd01234", b"cam/view_\xff\xfe_.png"])
def test_names_of_images(folder: Path, name: bytes) -> None:
    path = folder / "sparse/0/images.bin"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"cam/view_001.png", name))
    with pytest.raises(
        InputError, match=r"leaves the scene|holds control characters or is not UTF-8|in a name that is not UTF-8"
    ):
        load_scene(folder)
