"""The COLMAP folder that photographs become: images, images_2, images_4, images_8, sparse/0."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from PIL import Image

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.scene import BLACK

FACTORS = (2, 4, 8)


def check_target(scene: Path, source: Path) -> None:
    """Refuse a scene folder that holds something already, or that lies around or in the photographs.

    Raises:
        InputError: names the folder.
    """
    if scene.exists() and (scene.is_file() or any(scene.iterdir())):
        raise InputError(f"{scene} exists and is not an empty folder; give another SCENE.")
    if source.is_dir() and scene.resolve().is_relative_to(source.resolve()):
        raise InputError(f"{scene} lies in the folder of the photographs; give one outside of it.")


def write_scene(undistorted: Path, scene: Path, progress: Callable[[int], None]) -> int:
    """Turn COLMAP's undistorted folder into `scene`, with reduced copies; returns the number of photographs.

    `undistorted` must lie on the file system of `scene`: it is moved there as the last step.

    Args:
        progress: called with 1 for every photograph.
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
    if scene.exists():
        scene.rmdir()  # empty; Windows renames onto nothing that exists
    os.replace(content, scene)
    return len(images)
