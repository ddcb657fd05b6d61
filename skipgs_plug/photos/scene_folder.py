"""Write a scene as a COLMAP folder: images, images_2, images_4, images_8, sparse/0, and what it was made of."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

from skipgs_plug.photos.origin import Origin, write_origin
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import BLACK

FACTORS = (2, 4, 8)  # factors by which the sides of the reduced copies are shorter


def check_target(scene: Path, source: Path) -> None:
    """Raise an error unless the scene can be written to this folder.

    Raises:
        InputError: `scene` is a file, is not empty, or lies in the folder of the photographs.
    """
    if scene.exists() and (scene.is_file() or any(scene.iterdir())):
        raise InputError(f"{scene} exists and is not an empty folder; give another SCENE.")
    if source.is_dir() and scene.resolve().is_relative_to(source.resolve()):
        raise InputError(f"{scene} lies in the folder of the photographs; give a SCENE outside of it.")


def write_scene(undistorted: Path, scene: Path, origin: Origin, progress: Callable[[int], None]) -> int:
    """Turn COLMAP's undistorted folder into a scene with reduced copies; return the number of photographs.

    Args:
        undistorted: COLMAP's folder. It must be on the file system of `scene`, because the last step moves it there.
        scene: Folder of the scene, which does not exist or is empty.
        origin: What the scene is made of, which its folder says.
        progress: Called with 1 for each photograph.
    """
    content = undistorted.with_name("scene")
    (content / "sparse").mkdir(parents=True)
    (undistorted / "sparse").rename(content / "sparse" / "0")
    (undistorted / "images").rename(content / "images")
    if (undistorted / "masks").is_dir():
        (undistorted / "masks").rename(content / "masks")
    shutil.rmtree(undistorted)
    images = [path for path in sorted((content / "images").rglob("*")) if path.is_file()]
    for path in images:
        for factor in FACTORS:
            target = content / f"images_{factor}" / path.relative_to(content / "images")
            target.parent.mkdir(parents=True, exist_ok=True)
            pixels, _ = read_image(path, path, BLACK, factor)
            options: dict[str, Any] = {} if path.suffix.lower() == ".png" else {"quality": 95, "subsampling": 0}
            Image.fromarray(pixels.numpy()).save(target, **options)
        progress(1)
    write_origin(origin, content)
    if scene.exists():
        scene.rmdir()  # the folder is empty, and Windows cannot rename onto an existing folder
    os.replace(content, scene)
    return len(images)
