"""Blender folders (NeRF-synthetic): transforms_train.json, transforms_test.json (or _val), RGBA images."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.camera_keys import read_camera, values_of
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.json_file import opencv_viewmat, read_object, read_pose, read_string
from skipgs_plug.trainer.loaders.paths import find_image, find_images, inside
from skipgs_plug.trainer.loaders.photograph import PINHOLE_MODELS, load_photograph, model_name, scaled_matrix
from skipgs_plug.trainer.loaders.undistorted_cache import UndistortedCache
from skipgs_plug.trainer.ply import read_points
from skipgs_plug.trainer.scene import BLACK, WHITE, Scene, View, assemble_scene, split_views

HELD_OUT = ("transforms_test.json", "transforms_val.json")  # the first one that exists is used
BOX = 1.3  # half the edge of the cube of initial points; the value of 3DGS


def load_blender(
    path: Path,
    data_factor: int,
    test_every: int,
    init_num_pts: int,
    images: ImageStore,
    cloud: tuple[np.ndarray, np.ndarray] | None,
) -> Scene:
    """Load a Blender scene, transparency composed onto white; see `load_scene`.

    Points are `cloud` (points, colours), else those of `ply_file_path` in transforms_train.json, else random.
    """
    train, any_alpha = read_transforms(path, "transforms_train.json", data_factor, images)
    held_out = next((name for name in HELD_OUT if (path / name).is_file()), None)
    if held_out is not None:
        test, _ = read_transforms(path, held_out, data_factor, images)
        train, test = (sorted(views, key=lambda view: view.name) for views in (train, test))
    else:
        train, test = split_views(train, test_every)
    points, rgb = cloud or own_cloud(path, "transforms_train.json") or random_cloud(init_num_pts)
    background = WHITE if any_alpha else BLACK
    return assemble_scene(path, path.resolve().name, train, test, points, rgb, background)


def random_cloud(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points [count, 3] in the cube of 3DGS, and their colours."""
    rng = np.random.default_rng(0)
    return rng.uniform(-BOX, BOX, (count, 3)), rng.integers(0, 256, (count, 3))


def own_cloud(path: Path, file_name: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return points and colours of the file's `ply_file_path`; None if the file has no such entry."""
    name = read_object(path / file_name).get("ply_file_path")
    return None if name is None else read_points(inside(path, read_string(name, "ply_file_path", path / file_name)))


def read_transforms(path: Path, file_name: str, data_factor: int, images: ImageStore) -> tuple[list[View], bool]:
    """Return the views of one transforms file and whether any image has transparency."""
    source = path / file_name
    content = read_object(source)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise InputError(f"{source} lists no frames; restore the file.")
    views, any_alpha = [], False
    cache = UndistortedCache(path)
    names = [read_string(frame.get("file_path"), "file_path of a frame", source) for frame in frames]
    for frame, image_path in images.reading(list(zip(frames, find_images(path, names), strict=True))):
        view, alpha = read_frame(path, image_path, values_of(content, frame), cache, data_factor, images, source)
        views.append(view)
        any_alpha |= alpha
    return views, any_alpha


def read_frame(
    path: Path,
    image_path: Path,
    values: dict[str, Any],
    cache: UndistortedCache,
    data_factor: int,
    images: ImageStore,
    source: Path,
) -> tuple[View, bool]:
    """Return one view and whether its picture has transparency that was composed onto white."""
    name = image_path.relative_to(path).as_posix()
    viewmat = opencv_viewmat(read_pose(values.get("transform_matrix"), name, source))
    camera = read_camera(values, image_path, source)
    mask = values.get("mask_path")
    if mask is not None:
        mask = find_image(path, read_string(mask, f"mask_path of {name!r}", source))
    if mask is not None or model_name(camera) not in PINHOLE_MODELS:
        return load_photograph(name, image_path, camera, viewmat, cache, data_factor, mask, images), False
    size = (camera.width, camera.height)
    pixels, alpha = read_image(image_path, image_path, WHITE, data_factor, size)
    K = torch.from_numpy(scaled_matrix(camera, pixels))
    view = View(name, pixels, K, torch.from_numpy(viewmat))
    return images.keep(view, partial(read_opaque, image_path, data_factor, size)), alpha is not None


def read_opaque(image_path: Path, data_factor: int, size: tuple[int, int]) -> tuple[Tensor, None]:
    """Return the image [H, W, 3], composed onto white, which needs no mask."""
    return read_image(image_path, image_path, WHITE, data_factor, size)[0], None
