"""Kinds of images: read right, or refused by name before training begins."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scene_folders import write_colmap

from skipgs_plug.trainer import InputError, Scene, load_scene
from skipgs_plug.trainer.loaders.images import ORIENTATION, read_image

GREY = np.linspace(0, 255, 24 * 32).reshape(24, 32).astype(np.uint8)
RGB = np.stack([GREY, GREY[::-1], 255 - GREY], axis=2)


def read(path: Path, **options: object) -> np.ndarray:
    return read_image(path, path, **options)[0].numpy()  # type: ignore[arg-type]


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_16_bit_grey_is_scaled(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"deep.{suffix}"
    Image.fromarray(GREY.astype(np.uint16) * 257).save(path)
    np.testing.assert_array_equal(read(path), np.repeat(GREY[..., None], 3, axis=2))


def test_other_modes(tmp_path: Path) -> None:
    picture = Image.fromarray(RGB)
    for mode in ("1", "L", "P", "RGB", "CMYK"):
        path = tmp_path / f"{mode}.{'tif' if mode == 'CMYK' else 'png'}"
        picture.convert(mode).save(path)
        np.testing.assert_array_equal(read(path), np.asarray(picture.convert(mode).convert("RGB")), err_msg=mode)


@pytest.mark.parametrize(("kind", "word"), [(np.float32, "float"), (np.int32, "32-bit")])
def test_values_of_unknown_range_are_refused(tmp_path: Path, kind: type, word: str) -> None:
    path = tmp_path / "values.tif"
    Image.fromarray(GREY.astype(kind)).save(path)
    with pytest.raises(InputError, match=rf"values\.tif has {word} values, whose range is unknown"):
        read(path)


def test_transparency_is_kept_apart_or_composed(tmp_path: Path) -> None:
    path = tmp_path / "alpha.png"
    alpha = np.zeros((24, 32, 1), dtype=np.uint8)
    alpha[:, 16:] = 255
    Image.fromarray(np.concatenate([RGB, alpha], axis=2)).save(path)
    pixels, kept = read_image(path, path)
    np.testing.assert_array_equal(pixels, RGB)
    np.testing.assert_array_equal(kept, alpha[..., 0])
    white = read(path, background=(1.0, 1.0, 1.0))
    assert (white[:, :16] == 255).all()
    np.testing.assert_array_equal(white[:, 16:], RGB[:, 16:])


def test_transparent_grey_level_of_16_bits(tmp_path: Path) -> None:
    path = tmp_path / "level.png"
    Image.fromarray(GREY.astype(np.uint16) * 257).save(path, transparency=int(GREY[0, 0]) * 257)
    alpha = read_image(path, path)[1]
    np.testing.assert_array_equal(alpha, np.where(GREY[0, 0] == GREY, 0, 255))


@pytest.mark.parametrize("side", [16_000, 10_000])
def test_bomb(tmp_path: Path, side: int) -> None:
    path = tmp_path / "bomb.png"
    Image.new("1", (side, side)).save(path)
    with pytest.raises(InputError, match=r"bomb\.png has more than 89,478,485 pixels; shrink it"):
        read(path)


def test_orientation_is_applied_only_where_the_camera_asks_for_it(tmp_path: Path) -> None:
    path = tmp_path / "phone.png"
    exif = Image.Exif()
    exif[ORIENTATION] = 6
    Image.fromarray(RGB).save(path, exif=exif)
    np.testing.assert_array_equal(read(path, size=(64, 48)), RGB)
    np.testing.assert_array_equal(read(path, size=(48, 64)), np.rot90(RGB, -1))
    Image.fromarray(RGB).save(path)
    with pytest.raises(InputError, match=r"phone\.png is 32x24, .*48x64.*\(it seems to be rotated\)"):
        read(path, size=(48, 64))


def test_alpha_of_photographs_is_a_mask(tmp_path: Path, tiny_scene: Scene) -> None:
    folder = write_colmap(tiny_scene, tmp_path / "scan")
    path = folder / "images/cam/view_001.png"
    with Image.open(path) as opened:
        pixels = np.array(opened)
    alpha = np.full((24, 32, 1), 255, dtype=np.uint8)
    alpha[:5] = 0
    Image.fromarray(np.concatenate([pixels, alpha], axis=2)).save(path)
    view = load_scene(folder).train[0]
    assert torch.equal(view.image, torch.from_numpy(pixels))
    assert view.mask is not None and not view.mask[:5].any() and view.mask[5:].all()


@pytest.mark.parametrize("size", [(32, 32), (24, 32), (32, 1)])
def test_wrong_shape_is_not_stretched(tmp_path: Path, tiny_scene: Scene, size: tuple[int, int]) -> None:
    folder = write_colmap(tiny_scene, tmp_path / "scan")
    Image.new("RGB", size).save(folder / "images/cam/view_004.png")
    with pytest.raises(InputError, match=r"view_004\.png is \d+x\d+, but its camera is 32x24"):
        load_scene(folder)


def test_sides_that_ssim_cannot_measure(tmp_path: Path, tiny_scene: Scene) -> None:
    with pytest.raises(InputError, match=r"'cam/view_001\.png' is 1x1, but SSIM needs 11 pixels on each side"):
        load_scene(write_colmap(tiny_scene, tmp_path / "scan"), data_factor=30)
