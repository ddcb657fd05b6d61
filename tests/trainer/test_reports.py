"""Public reports about scenes, each rebuilt as a small input; SITUATIONS.md lists their sources."""

from __future__ import annotations

import json
import shutil
import struct
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch
from PIL import Image
from scene_folders import write_blender, write_colmap
from test_properties import write_binary, write_cloud, write_nerfstudio

from skipgs_plug.trainer import InputError, MissingFileError, Scene, load_scene
from skipgs_plug.trainer.ply import read_ply


@pytest.fixture
def colmap(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_colmap(tiny_scene, tmp_path / "scene")


@pytest.fixture
def nerf(tmp_path: Path, tiny_scene: Scene) -> Path:
    return write_nerfstudio(tiny_scene, tmp_path / "scene")


def change_frames(root: Path, change) -> None:
    file = root / "transforms.json"
    content = json.loads(file.read_text())
    for number, frame in enumerate(content["frames"]):
        change(number, frame)
    file.write_text(json.dumps(content))


def pixels(scene: Scene) -> list[torch.Tensor]:
    return [view.image for view in sorted(scene.train + scene.test, key=lambda view: PurePosixPath(view.name).name)]


def same(first: Scene, second: Scene) -> bool:
    return all(torch.equal(a, b) for a, b in zip(pixels(first), pixels(second), strict=True))


@pytest.mark.parametrize("rename", [str.upper, str.lower, lambda name: name.replace(".png", ".PNG").title()])
def test_names_of_another_case(colmap: Path, rename) -> None:
    expected = load_scene(colmap)
    for path in sorted((colmap / "images/cam").iterdir()):
        path.rename(path.with_name(rename(path.name)))
    (colmap / "images/cam").rename(colmap / "images" / rename("cam"))
    assert same(load_scene(colmap), expected)


def test_folders_of_another_case(colmap: Path) -> None:
    view = load_scene(colmap).train[0]
    mask = colmap / "Masks" / f"{view.name}.png"
    mask.parent.mkdir(parents=True)
    Image.fromarray(np.uint8([[0, 255]]).repeat(view.height, 0).repeat(view.width // 2, 1)).save(mask)
    (colmap / "images").rename(colmap / "Images")
    found = load_scene(colmap).train[0]
    assert torch.equal(found.image, view.image)
    assert found.mask is not None and not found.mask.all()


def test_colours_of_a_text_model_as_decimal_numbers(colmap: Path) -> None:
    expected = load_scene(colmap).points_rgb
    file = colmap / "sparse/0/points3D.txt"
    rows = [line.split() for line in file.read_text().splitlines()]
    file.write_text("\n".join(" ".join([*row[:4], *(f"{row[i]}.0" for i in (4, 5, 6)), *row[7:]]) for row in rows))
    assert torch.equal(load_scene(colmap).points_rgb, expected)


def test_two_files_that_differ_by_case_are_told_apart(colmap: Path) -> None:
    folder = colmap / "images/cam"
    shutil.copy(folder / "view_001.png", folder / "VIEW_000.png")
    expected = load_scene(colmap)
    assert not torch.equal(*(view.image for view in expected.train[:1] + expected.test[:1]))
    (folder / "view_000.png").unlink()
    shutil.copy(folder / "view_002.png", folder / "View_000.png")
    with pytest.raises(MissingFileError, match=r"view_000\.png does not exist"):
        load_scene(colmap)


@pytest.mark.parametrize(
    "start",
    ["/home/someone/dataset/", "C:\\Users\\someone\\dataset\\", "./..\\nerf_dataset\\canister\\", "data/nerf/fox/"],
)
def test_paths_of_another_place(nerf: Path, start: str) -> None:
    expected = load_scene(nerf)

    def lead(_: int, frame: dict) -> None:
        path = frame["file_path"].replace("/", "\\") if "\\" in start else frame["file_path"]
        frame["file_path"] = start + path

    change_frames(nerf, lead)
    assert same(load_scene(nerf), expected)
    (nerf / "images/view_004.png").unlink()
    with pytest.raises(InputError, match=r"view_004\.png' leaves the scene|view_004\.png does not exist"):
        load_scene(nerf)


def test_an_image_of_another_camera_does_not_stand_in(nerf: Path) -> None:
    shutil.copy(nerf / "images/view_001.png", nerf / "view_004.png")
    (nerf / "images/view_004.png").unlink()
    with pytest.raises(MissingFileError, match=r"view_004\.png does not exist"):
        load_scene(nerf)


def test_missing_images_are_counted(colmap: Path) -> None:
    for number in (3, 5, 6):
        (colmap / f"images/cam/view_{number:03d}.png").unlink()
    with pytest.raises(MissingFileError, match=r"view_003\.png does not exist, and neither do 2 others of 10"):
        load_scene(colmap)


def test_a_format_that_is_not_read_is_named(colmap: Path) -> None:
    path = colmap / "images/cam/view_004.png"
    path.rename(path.with_suffix(".exr"))
    with pytest.raises(MissingFileError, match=r"\(view_004\.exr is there, which is not read: convert it"):
        load_scene(colmap)


def test_a_folder_and_a_broken_link_in_place_of_an_image_are_named(colmap: Path) -> None:
    path = colmap / "images/cam/view_004.png"
    path.unlink()
    path.mkdir()
    with pytest.raises(MissingFileError, match=r"view_004\.png does not exist \(a folder has its name\)"):
        load_scene(colmap)
    path.rmdir()
    path.symlink_to("gone.png")
    with pytest.raises(MissingFileError, match=r"does not exist \(a link to gone\.png has its name\)"):
        load_scene(colmap)


@pytest.mark.parametrize("write", [write_colmap, write_binary])
def test_points_only_as_ply_or_given(tmp_path: Path, tiny_scene: Scene, write) -> None:
    root = write(tiny_scene, tmp_path / "scene")
    expected = load_scene(root)
    for path in (root / "sparse/0").glob("points3D.*"):
        path.unlink()
    with pytest.raises(InputError, match=r"has 0 points.*--init-ply"):
        load_scene(root)
    write_cloud(tiny_scene, tmp_path / "cloud.ply")
    given = load_scene(root, init_ply=tmp_path / "cloud.ply")
    shutil.copy(tmp_path / "cloud.ply", root / "sparse/0/points3D.ply")
    for scene in (given, load_scene(root)):
        assert same(scene, expected)
        assert torch.equal(scene.points, expected.points)
        assert torch.equal(scene.points_rgb, expected.points_rgb)


def test_observations_of_a_binary_model_without_points(tmp_path: Path, tiny_scene: Scene) -> None:
    """Images list observations of points that are not there."""
    root = write_binary(tiny_scene, tmp_path / "scene")
    expected = load_scene(root)
    file = root / "sparse/0/images.bin"
    data = file.read_bytes()
    name = data.index(b"\0", 8 + 64) + 1
    observations = struct.pack("<Q", 2) + struct.pack("<ddQddQ", 1.5, 2.5, 7, 3.5, 4.5, 2**64 - 1)
    file.write_bytes(data[:name] + observations + data[name + 8 :])
    (root / "sparse/0/points3D.bin").unlink()
    write_cloud(tiny_scene, tmp_path / "cloud.ply")
    scene = load_scene(root, init_ply=tmp_path / "cloud.ply")
    for first, second in zip(scene.train, expected.train, strict=True):
        assert torch.equal(first.viewmat, second.viewmat)


def test_masks_of_cameras_with_equal_names(nerf: Path) -> None:
    for folder in ("front", "back"):
        (nerf / "images" / folder).mkdir()
        (nerf / "masks" / folder).mkdir(parents=True)

    def place(number: int, frame: dict) -> None:
        folder, name = ("front", "back")[number % 2], f"{number // 2:06d}.png"
        (nerf / frame["file_path"]).rename(nerf / "images" / folder / name)
        frame.update(file_path=f"images/{folder}/{name}", mask_path=f"masks/{folder}/{name}")
        mask = np.full((24, 32), 255, dtype=np.uint8)
        mask[number] = 0
        Image.fromarray(mask).save(nerf / "masks" / folder / name)

    change_frames(nerf, place)
    for _ in range(2):  # once by the frame, once by the folder
        scene = load_scene(nerf)
        for view in scene.train + scene.test:
            number = 2 * int(PurePosixPath(view.name).stem) + ("back" in view.name)
            assert view.mask is not None
            assert (~view.mask).all(dim=1).nonzero()[:, 0].tolist() == [number]
        change_frames(nerf, lambda _, frame: frame.pop("mask_path", None))


def test_masks_of_other_suffixes_are_found_and_others_counted(colmap: Path, caplog: pytest.LogCaptureFixture) -> None:
    folder = colmap / "masks/cam"
    folder.mkdir(parents=True)
    half = np.zeros((24, 32), dtype=np.uint8)
    half[:, 16:] = 255
    for number, name in enumerate(["view_000.JPG", "view_001.png.png", "View_002.png", "view_003.tif", "mask_4.png"]):
        Image.fromarray(half).save(folder / name, **({"quality": 100} if number == 0 else {}))
    scene = load_scene(colmap)
    masked = [view.name for view in scene.train + scene.test if view.mask is not None]
    assert sorted(masked) == [f"cam/view_{number:03d}.png" for number in range(4)]
    assert "6 of 10 views have no mask" in caplog.text
    assert "1 masks have no view of that name, such as cam/mask_4.png" in caplog.text


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        ("FULL_OPENCV 32 24 30 30 16 12 0.01 0 0 0", "camera 1 has 8 parameters, but its model FULL_OPENCV has 12"),
        ("PINHOLE 32 24 30 16 12", "camera 1 has 3 parameters, but its model PINHOLE has 4"),
        ("SPHERICAL 32 24 32 24", "cannot be read"),
    ],
)
def test_cameras_that_are_none(colmap: Path, camera: str, said: str) -> None:
    (colmap / "sparse/0/cameras.txt").write_text(f"1 {camera}\n")
    with pytest.raises(InputError, match=said):
        load_scene(colmap)


def test_pointers_of_git_lfs_are_named(colmap: Path) -> None:
    pointer = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
    (colmap / "model.ply").write_text(pointer)
    with pytest.raises(InputError, match=r"Git LFS pointer.*git lfs pull"):
        read_ply(colmap / "model.ply")
    (colmap / "images/cam/view_003.png").write_text(pointer)
    with pytest.raises(InputError, match=r"view_003\.png cannot be decoded: it is a Git LFS pointer"):
        load_scene(colmap)
    for name in ("cameras", "images", "points3D"):
        (colmap / f"sparse/0/{name}.bin").write_text(pointer)
    with pytest.raises(InputError, match="Git LFS pointer"):
        load_scene(colmap)


def test_names_with_dots(nerf: Path) -> None:
    """In a name without a suffix, the text after the last dot is part of the name."""

    def rename(number: int, frame: dict) -> None:
        new = f"images/IMG.{number:04d}"
        (nerf / frame["file_path"]).rename(nerf / f"{new}.png")
        frame["file_path"] = new

    expected = load_scene(nerf)
    change_frames(nerf, rename)
    shutil.copy(nerf / "images/IMG.0003.png", nerf / "images/IMG.png")
    scene = load_scene(nerf)
    assert same(scene, expected)


def test_several_cameras_in_one_file(nerf: Path) -> None:
    """The intrinsics of a frame stand over those of the file; sizes differ."""

    def other(number: int, frame: dict) -> None:
        if number % 2:
            frame.update(w=64, h=30, fl_x=70.0, fl_y=71.0, cx=31.0, cy=14.0)
            path = nerf / frame["file_path"]
            Image.open(path).resize((64, 30)).save(path)

    change_frames(nerf, other)
    scene = load_scene(nerf, test_every=0)
    for number, view in enumerate(scene.train):
        assert (view.width, view.height) == ((64, 30) if number % 2 else (32, 24))
        if number % 2:
            assert view.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist() == [70, 71, 31, 14]


def test_masks_are_undistorted_as_their_images(nerf: Path) -> None:
    """A picture that is its own mask stays so."""
    file = nerf / "transforms.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps({**content, "k1": -0.3, "k2": 0.05}))
    board = ((np.indices((24, 32)) // 6).sum(axis=0) % 2 * 255).astype(np.uint8)

    def draw(_: int, frame: dict) -> None:
        name = Path(frame["file_path"]).name
        (nerf / "masks").mkdir(exist_ok=True)
        Image.fromarray(board).save(nerf / "masks" / name)
        Image.fromarray(np.repeat(board[..., None], 3, axis=2)).save(nerf / frame["file_path"])
        frame["mask_path"] = f"masks/{name}"

    change_frames(nerf, draw)
    view = load_scene(nerf).train[0]
    assert view.mask is not None
    white, black = view.image[..., 0] > 192, view.image[..., 0] < 64
    assert bool(view.mask[white].all()) and not bool(view.mask[black].any())
    assert min(int(white.sum()), int(black.sum())) > 200


@pytest.mark.parametrize("kind", ["colmap", "nerfstudio"])
def test_images_that_no_file_lists_are_counted(tmp_path: Path, tiny_scene: Scene, kind: str, caplog) -> None:
    write = write_colmap if kind == "colmap" else write_nerfstudio
    root = write(tiny_scene, tmp_path / "scene")
    load_scene(root)
    assert not caplog.text
    listed = next((root / "images").rglob("view_003.png"))
    for name in ("unplaced.png", "later.JPG", ".hidden.png", "notes.txt", ".ipynb_checkpoints/x.png"):
        (listed.parent / name).parent.mkdir(exist_ok=True)
        Image.open(listed).save(listed.parent / name, format="PNG")
    load_scene(root)
    assert "2 of its images are not among the " in caplog.text
    assert "later.JPG" in caplog.text


def test_transforms_from_powershell(nerf: Path) -> None:
    expected = load_scene(nerf)
    text = (nerf / "transforms.json").read_text()
    for encoding in ("utf-16", "utf-8-sig"):
        (nerf / "transforms.json").write_bytes(text.encode(encoding))
        assert same(load_scene(nerf), expected)


def test_moving_scenes_are_named(nerf: Path, caplog: pytest.LogCaptureFixture) -> None:
    change_frames(nerf, lambda number, frame: frame.update(time=number / 10))
    load_scene(nerf)
    assert "the frames have different times" in caplog.text


def test_masks_of_transparency_and_of_lossy_formats(colmap: Path) -> None:
    """Masks of every number format have their intended meaning (LichtFeld-Studio#547)."""
    folder = colmap / "masks/cam"
    folder.mkdir(parents=True)
    half = np.zeros((24, 32), dtype=np.uint8)
    half[:, 16:] = 255
    white = np.full((24, 32, 3), 255, dtype=np.uint8)
    Image.fromarray(np.dstack([white, half])).save(folder / "view_000.png")
    Image.fromarray(half).save(folder / "view_001.jpg", quality=30)
    Image.fromarray(half // 255).save(folder / "view_002.png")  # grey levels 0 and 1
    Image.fromarray(half > 0).save(folder / "view_003.png")  # one bit per pixel
    palette = Image.fromarray(half // 255, mode="L").convert("P")
    palette.putpalette([0, 0, 0, 255, 255, 255])
    palette.save(folder / "view_004.png")
    scene = load_scene(colmap)
    masks = {view.name: view.mask for view in scene.train + scene.test}
    for number in range(5):
        mask = masks[f"cam/view_{number:03d}.png"]
        assert mask is not None
        assert torch.equal(mask, torch.from_numpy(half > 0)), number


def test_a_text_model_beside_a_binary_one(tmp_path: Path, tiny_scene: Scene, caplog) -> None:
    """A further member of "records that are never looked at": somebody edited images.txt, images.bin is read."""
    root = write_colmap(tiny_scene, tmp_path / "text")
    binary = write_binary(tiny_scene, tmp_path / "scene") / "sparse/0"
    for path in (root / "sparse/0").iterdir():
        shutil.copy(path, binary)
    assert len(load_scene(tmp_path / "scene").train) == 8
    assert not caplog.text
    lines = (binary / "images.txt").read_text().splitlines()
    (binary / "images.txt").write_text("\n".join(lines[:12]) + "\n")
    load_scene(tmp_path / "scene")
    assert "images.bin lists 10 images and is read; images.txt lists 6" in caplog.text


def test_a_validation_file_is_held_out_where_there_is_no_other(tmp_path: Path, tiny_scene: Scene) -> None:
    root = write_blender(tiny_scene, tmp_path / "scene")
    (root / "transforms_test.json").rename(root / "transforms_val.json")
    scene = load_scene(root)
    assert (len(scene.train), len(scene.test)) == (8, 2)


def test_points_that_are_lost_are_counted(colmap: Path) -> None:
    """A further member of "records lost": two points of one number, of which one is read."""
    file = colmap / "sparse/0/points3D.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines, lines[0].replace(" 0.5", " 0.7")]) + "\n")
    with pytest.raises(InputError, match=r"lists 161 points, but only 160 can be read|cannot be read"):
        load_scene(colmap)
