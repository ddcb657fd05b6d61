"""Loaders of scenes, one file per format; each returns a `Scene`."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from skipgs_plug.install import next_command
from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.blender import load_blender
from skipgs_plug.trainer.loaders.colmap import MODEL_FOLDERS, is_model, load_colmap
from skipgs_plug.trainer.loaders.nerfstudio import load_nerfstudio
from skipgs_plug.trainer.loaders.packed import load_packed
from skipgs_plug.trainer.ply import read_start
from skipgs_plug.trainer.scene import Scene

TRANSFORMS = ("transforms_train.json", "transforms.json")


def is_scene(folder: Path) -> bool:
    """Return whether `load_scene` recognises the content of a folder."""
    return (
        is_model(folder)
        or any((folder / name).is_dir() for name in MODEL_FOLDERS)
        or any((folder / name).is_file() for name in TRANSFORMS)
    )


def load_scene(
    path: str | Path,
    data_factor: int = 1,
    test_every: int = 8,
    init_num_pts: int = 100_000,
    init_ply: str | Path | None = None,
    images: ImageStore | None = None,
) -> Scene:
    """Load a COLMAP, nerfstudio or Blender folder or a packed .npz file.

    The only file written into a scene is `undistorted_cache`, when its cameras are distorted and it is writable.

    Args:
        path: A folder with `sparse/0` or `sparse`, one model of such a folder (SCENE/sparse/1), a folder with
            `transforms_train.json` or `transforms.json`, or an .npz file.
        data_factor: Read `images_{data_factor}`; if that folder is missing, shrink `images` in memory.
        test_every: Hold out every n-th view by name (index % n == 0); 0 holds out no view. Blender scenes with
            `transforms_test.json`, nerfstudio files with `train_filenames` and packed files have their own split.
        init_num_pts: Number of random points for a Blender scene, which has no point cloud.
        init_ply: Point cloud or 3DGS model to start from instead of the scene's points, in coordinates of the scene.
        images: Bounds the memory of decoded photographs. None: a quarter of the memory that is free.

    Raises:
        MissingFileError: A folder or an image does not exist.
        InputError: The content cannot be used, such as an unknown camera model, points that are missing or not
            finite, or a damaged image.

    Examples:
        >>> import tempfile
        >>> from skipgs_plug.trainer import load_scene, save_packed
        >>> from skipgs_plug.trainer.synthetic import make_scene
        >>> folder = tempfile.TemporaryDirectory()
        >>> save_packed(make_scene(n_views=10, width=32, height=24, n_points=160), f"{folder.name}/small.npz")
        >>> scene = load_scene(f"{folder.name}/small.npz")
        >>> len(scene.train), len(scene.test), scene.train[0].image.shape
        (8, 2, torch.Size([24, 32, 3]))
        >>> folder.cleanup()
    """
    path = Path(path).expanduser()
    images = images or ImageStore()
    cloud, gaussians = read_start(init_ply) if init_ply else (None, None)
    if not path.exists():
        raise MissingFileError(
            f"Scene {path} does not exist; give a COLMAP, nerfstudio or Blender folder or a packed .npz."
        )
    if path.is_file():
        if path.suffix != ".npz":
            raise InputError(f"Scene {path} is a file but not a packed .npz; give the folder that holds it.")
        scene = load_packed(path, cloud)
    elif is_model(path) or (path / "sparse").is_dir():
        scene = load_colmap(path, data_factor, test_every, images, cloud)
    elif (path / "transforms_train.json").is_file():
        scene = load_blender(path, data_factor, test_every, init_num_pts, images, cloud)
    elif (path / "transforms.json").is_file():
        scene = load_nerfstudio(path, data_factor, test_every, images, cloud)
    elif (path / "colmap" / "sparse").is_dir():
        scene = load_colmap(path, data_factor, test_every, images, cloud)
    else:
        raise MissingFileError(
            f"Scene {path} holds neither {path / 'sparse' / '0'} (COLMAP) nor {path / 'transforms_train.json'} "
            f"(Blender) nor transforms.json (nerfstudio); for photographs run: {next_command('sfm', path, 'SCENE')}."
        )
    if cloud is None:
        return scene
    return dataclasses.replace(scene, gaussians=gaussians and scene.frame.local_splats(gaussians))
