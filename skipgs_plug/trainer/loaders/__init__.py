"""One file per scene format; each makes a `Scene` of what it reads."""

from __future__ import annotations

from pathlib import Path

from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.loaders.blender import load_blender
from skipgs_plug.trainer.loaders.colmap import load_colmap
from skipgs_plug.trainer.loaders.packed import load_packed
from skipgs_plug.trainer.scene import Scene


def load_scene(path: str | Path, data_factor: int = 1, test_every: int = 8, init_num_pts: int = 100_000) -> Scene:
    """Load a COLMAP folder, a Blender folder or a packed .npz. Writes nothing.

    Args:
        path: folder with `sparse/0` or `sparse`, folder with `transforms_train.json`, or .npz file.
        data_factor: use `images_{data_factor}`; resized in memory when that folder is missing.
        test_every: views sorted by name, index % test_every == 0 held out; 0 holds out none. Blender scenes
            with `transforms_test.json` and packed files bring their own split.
        init_num_pts: random points for a Blender scene, which has no point cloud.

    Raises:
        MissingFileError: a folder or image is not there.
        InputError: the content cannot be used (camera model, empty or non-finite points, damaged image...).
    """
    path = Path(path).expanduser()
    if not path.exists():
        raise MissingFileError(f"Scene {path} does not exist; give a COLMAP folder, Blender folder or packed .npz.")
    if path.is_file():
        if path.suffix != ".npz":
            raise InputError(f"Scene {path} is a file but not a packed .npz; give the folder that holds it.")
        return load_packed(path)
    if (path / "sparse").is_dir():
        return load_colmap(path, data_factor, test_every)
    if (path / "transforms_train.json").is_file():
        return load_blender(path, data_factor, test_every, init_num_pts)
    raise MissingFileError(
        f"Scene {path} holds neither {path / 'sparse' / '0'} (COLMAP) nor "
        f"{path / 'transforms_train.json'} (Blender); run COLMAP on it or give another folder."
    )
