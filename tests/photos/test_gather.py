"""Photographs as they come from phones and cameras: orientation, formats, sharp and blurred frames."""

from __future__ import annotations

import subprocess

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from skipgs_plug.cli import main
from skipgs_plug.photos.gather import gather
from skipgs_plug.photos.video import sharpest_frames, sharpness
from skipgs_plug.trainer import InputError
from skipgs_plug.trainer.loaders.images import ORIENTATION

# imageio-ffmpeg does not close the pipes of a finished decoder; the garbage collector does.
LEAVES_PIPES = "ignore:unclosed file:ResourceWarning"


@pytest.fixture
def pattern() -> np.ndarray:
    """Blocks of 4x4 pixels in random colours, 96x64."""
    blocks = np.random.default_rng(0).integers(0, 256, (16, 24, 3), dtype=np.uint8)
    return blocks.repeat(4, axis=0).repeat(4, axis=1)


def blur(image: np.ndarray, size: int) -> np.ndarray:
    """Return the image averaged over shifts of up to `size` pixels to the right: motion."""
    return np.mean([np.roll(image, k, axis=1) for k in range(size)], axis=0).astype(np.uint8)


def test_photographs_are_turned_upright_and_keep_what_exif_says(pattern, tmp_path):
    source = tmp_path / "source"
    (source / "left").mkdir(parents=True)
    exif = Image.Exif()
    exif[0x0110] = "Camera"
    for name, orientation in (("a.jpg", 1), ("b.jpg", 6), ("left/c.jpg", 1)):
        exif[ORIENTATION] = orientation
        picture = Image.fromarray(np.rot90(pattern) if orientation == 6 else pattern)
        picture.save(source / name, exif=exif, quality=95)
    (source / "notes.txt").write_text("no photograph")
    (source / "._a.jpg").write_text("what macOS leaves on foreign disks")
    counted = []
    gathered = gather(source, tmp_path / "photos", 10, counted.append)
    assert gathered.names == ["a.jpg", "b.jpg", "left/c.jpg"] and sum(counted) == 3
    assert gathered.one_camera
    upright, turned = (Image.open(gathered.folder / name) for name in ("a.jpg", "b.jpg"))
    assert upright.size == turned.size == (96, 64)
    assert turned.getexif().get(ORIENTATION, 1) == 1 and turned.getexif()[0x0110] == "Camera"
    assert np.abs(np.array(upright, dtype=float) - np.array(turned, dtype=float)).mean() < 3
    assert (source / "a.jpg").stat().st_ino == (gathered.folder / "a.jpg").stat().st_ino  # linked, not copied


def test_other_formats_are_converted_and_sizes_tell_cameras_apart(pattern, tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    Image.fromarray(pattern).save(source / "a.webp", quality=95)
    Image.fromarray(pattern).save(source / "a.bmp")
    Image.fromarray(pattern[:, :60]).save(source / "b.png")
    gathered = gather(source, tmp_path / "photos", 10, lambda n: None)
    assert gathered.names == ["a.bmp.jpg", "a.webp.jpg", "b.png"] and not gathered.one_camera
    assert (gathered.folder / "a.bmp.jpg").read_bytes()[:2] == b"\xff\xd8"  # JPEG


def test_a_link_to_nothing_is_named(pattern, tmp_path):
    for name in "abc":
        Image.fromarray(pattern).save(tmp_path / f"{name}.png")
    (tmp_path / "d.JPG").symlink_to(tmp_path / "elsewhere.jpg")
    with pytest.raises(InputError, match=r"d\.JPG links to a file that does not exist"):
        gather(tmp_path, tmp_path / "photos", 10, lambda n: None)


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        ((), "gives no photograph;"),
        (("a.png",), "gives only 1 photograph;"),
        (("a.png", "b.png"), "gives only 2 photographs;"),
        (("a.heic",), "a.heic has a format that this package cannot read; export as JPEG."),
        (
            ("a.heic", "b.NEF"),
            "a.heic has a format that this package cannot read (1 more of this kind); export as JPEG.",
        ),
    ],
)
def test_too_few_or_unreadable_photographs_are_counted(pattern, tmp_path, names, sentence):
    source = tmp_path / "source"
    source.mkdir()
    for name in names:
        Image.fromarray(pattern).save(source / name, format="PNG")
    with pytest.raises(InputError) as refused:
        gather(source, tmp_path / "photos", 10, lambda n: None)
    assert sentence in str(refused.value)


def test_an_error_has_a_line_of_its_own_where_bars_cannot_be_wiped_out(tmp_path, capsys):
    (tmp_path / "photographs").mkdir()
    assert main(["sfm", str(tmp_path / "photographs"), str(tmp_path / "scene")]) == 2
    assert "\nskipgs-plug: " in capsys.readouterr().err


@pytest.mark.filterwarnings(LEAVES_PIPES)
def test_the_sharpest_frame_of_each_group_is_taken(pattern, tmp_path):
    shifted = [np.roll(pattern, 4 * i, axis=0) for i in range(12)]
    sharp = (1, 3, 8, 10)
    frames = [image if i in sharp else blur(image, 7) for i, image in enumerate(shifted)]
    path = tmp_path / "video.mp4"
    iio.imwrite(path, np.stack(frames), plugin="FFMPEG", fps=10, quality=10, macro_block_size=2)
    taken = list(sharpest_frames(path, 4))
    assert tuple(number for number, _ in taken) == sharp
    for number, frame in taken:
        assert np.abs(frame.astype(float) - shifted[number]).mean() < 25  # of 255, after lossy compression
    assert [number for number, _ in sharpest_frames(path, 50)] == list(range(12))


def test_a_damaged_video_is_named(tmp_path):
    path = tmp_path / "video.mp4"
    path.write_bytes(b"no video")
    with pytest.raises(InputError, match=r"video\.mp4 cannot be decoded"):
        gather(path, tmp_path / "photos", 10, lambda n: None)


def test_sharpness_falls_with_blur(pattern):
    levels = [sharpness(image) for image in (pattern, blur(pattern, 3), blur(pattern, 7))]
    assert levels[0] > 2 * levels[1] > 2 * levels[2] > 0


def test_linked_folders_and_transparency(pattern, tmp_path):
    source, store = tmp_path / "source", tmp_path / "store"
    (source / "day1").mkdir(parents=True)
    store.mkdir()
    for name in ("day1/a.png", "day1/b.png"):
        Image.fromarray(pattern).save(source / name)
    alpha = np.full(pattern.shape[:2], 255, dtype=np.uint8)
    alpha[:, :40] = 0
    Image.fromarray(np.dstack([pattern, alpha])).save(store / "c.png")
    (source / "day2").symlink_to(store)
    (store / "round").symlink_to(source)  # a circle of links is followed once
    gathered = gather(source, tmp_path / "work" / "photos", 0, lambda _: None)
    assert gathered.names == ["day1/a.png", "day1/b.png", "day2/c.png"]
    assert [path.name for path in gathered.masks.rglob("*.png")] == ["c.png.png"]
    mask = np.array(Image.open(gathered.masks / "day2" / "c.png.png"))
    np.testing.assert_array_equal(mask, alpha)


def test_what_programs_leave_in_folders_is_no_photograph(pattern, tmp_path):
    """Files that Jupyter, file managers and macOS put beside photographs are left out."""
    source = tmp_path / "source"
    kept = ["front/0001.png", "back/0001.png", "back/0002.png"]  # cameras of a rig give the same names
    left = [".ipynb_checkpoints/0001-checkpoint.png", "front/.thumbnails/0001.png", "front/._0001.png"]
    for number, name in enumerate(kept + left):
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.roll(pattern, 4 * number, axis=0)).save(source / name)
    gathered = gather(source, tmp_path / "photos", 10, lambda n: None)
    assert gathered.names == sorted(kept)
    for number, name in enumerate(kept):
        assert np.array_equal(np.array(Image.open(gathered.folder / name)), np.roll(pattern, 4 * number, axis=0))


@pytest.mark.filterwarnings(LEAVES_PIPES)
@pytest.mark.parametrize("turn", [90, 180, 270])
def test_a_video_that_was_held_upright(pattern, tmp_path, turn):
    """Phones store the pixels as the sensor lies, and how they are to be turned."""
    from imageio_ffmpeg import get_ffmpeg_exe

    lying, stored = tmp_path / "lying.mp4", tmp_path / "stored.mp4"
    iio.imwrite(lying, np.stack([pattern] * 4), plugin="FFMPEG", fps=10, quality=10, macro_block_size=2)
    command = [
        get_ffmpeg_exe(),
        "-v",
        "error",
        "-display_rotation",
        str(turn),
        "-i",
        str(lying),
        "-c",
        "copy",
        str(stored),
    ]
    subprocess.run(command, check=True)
    taken = [frame for _, frame in sharpest_frames(stored, 4)]
    assert len(taken) == 4
    upright = np.rot90(pattern, turn // 90).astype(float)
    for frame in taken:
        assert frame.shape == upright.shape
        assert np.abs(frame - upright).mean() < 25


def test_reduced_copies_are_left_out(pattern, tmp_path):
    """Folders of Mip-NeRF 360 and LLFF hold each photograph in several sizes."""
    photograph = Image.fromarray(pattern)
    sizes = {"images": 1, "images_4": 4, "images_8_png": 8, "evening_2": 2, "walk": 1, "walk_2": 1}
    for name, factor in sizes.items():
        (tmp_path / name).mkdir()
        for number in (1, 2):  # the second walk has other photographs of the same names
            file = tmp_path / name / f"{number}.{'png' if name.endswith('png') else 'jpg'}"
            photograph.resize((round(photograph.width / factor), round(photograph.height / factor))).save(file)
    names = gather(tmp_path, tmp_path.with_name("gathered"), 10, lambda n: None).names
    assert names == [f"{folder}/{n}.jpg" for folder in ("evening_2", "images", "walk", "walk_2") for n in (1, 2)]
