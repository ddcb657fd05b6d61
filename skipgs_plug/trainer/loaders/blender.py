"""Blender folders (NeRF-synthetic): transforms_train.json, transforms_test.json, RGBA images."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.json_file import read_number, read_object, read_pose, read_string
from skipgs_plug.trainer.loaders.paths import IMAGE_SUFFIXES, find_image, inside
from skipgs_plug.trainer.scene import BLACK, WHITE, Scene, View, assemble_scene, split_views

BOX = 1.3  # half edge of the cube of initial points, as in 3DGS


def load_blender(path: Path, data_factor: int, test_every: int, init_num_pts: int, images: ImageStore) -> Scene:
    """Load a Blender scene, transparency composed onto white; see `load_scene`."""
    train, any_alpha = read_transforms(path, "transforms_train.json", data_factor, images)
    if (path / "transforms_test.json").is_file():
        test, _ = read_transforms(path, "transforms_test.json", data_factor, images)
        train, test = (sorted(views, key=lambda view: view.name) for views in (train, test))
    else:
        train, test = split_views(train, test_every)
    rng = np.random.default_rng(0)
    points = rng.uniform(-BOX, BOX, (init_num_pts, 3))
    rgb = rng.integers(0, 256, (init_num_pts, 3))
    background = WHITE if any_alpha else BLACK
    return assemble_scene(path, path.resolve().name, train, test, points, rgb, background)


def read_transforms(path: Path, file_name: str, data_factor: int, images: ImageStore) -> tuple[list[View], bool]:
    """Return the views of one transforms file and whether any image has transparency."""
    source = path / file_name
    content = read_object(source)
    angle = read_number(content.get("camera_angle_x"), "camera_angle_x", source)
    frames = content.get("frames")
    if not 0.0 < angle < math.pi:
        raise InputError(f"{source}: camera_angle_x is {angle:g}, not between 0 and pi; restore the file.")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise InputError(f"{source} lists no frames; restore the file.")
    views, any_alpha = [], False
    for frame in images.reading(frames):
        file_path = read_string(frame.get("file_path"), "file_path of a frame", source)
        pose = read_pose(frame.get("transform_matrix"), file_path, source)
        image_path = find_image(path, _with_suffix(path, file_path))
        pixels, alpha = read_image(image_path, image_path, WHITE, data_factor)
        any_alpha |= alpha is not None
        height, width = pixels.shape[:2]
        focal = 0.5 * width / math.tan(0.5 * angle)
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        viewmat = torch.from_numpy(opencv_viewmat(pose)).float()
        view = View(image_path.relative_to(path).as_posix(), pixels, K, viewmat)
        views.append(images.keep(view, partial(read_opaque, image_path, data_factor)))
    return views, any_alpha


def read_opaque(image_path: Path, data_factor: int) -> tuple[Tensor, None]:
    """Return the image [H, W, 3], composed onto white, which needs no mask."""
    return read_image(image_path, image_path, WHITE, data_factor)[0], None


def _with_suffix(folder: Path, name: str) -> str:
    """NeRF-synthetic leaves the images' suffix out, and what is left may hold a dot ("train/r_0.5")."""
    whole = Path(name).suffix in IMAGE_SUFFIXES or os.path.isfile(inside(folder, name))
    return name if whole else name + ".png"


def opencv_viewmat(camera_to_world: np.ndarray) -> np.ndarray:
    """Return world to camera [4, 4] of an OpenGL pose, which looks along -z with y up."""
    return np.linalg.inv(camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))
