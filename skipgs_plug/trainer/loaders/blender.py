"""Blender folders (NeRF-synthetic): transforms_train.json, transforms_test.json, RGBA images."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import torch

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.loaders.images import find_image, read_image
from skipgs_plug.trainer.scene import BLACK, WHITE, Scene, View, assemble_scene, split_views

BOX = 1.3  # half edge of the cube of initial points, as in 3DGS


def load_blender(path: Path, data_factor: int, test_every: int, init_num_pts: int) -> Scene:
    """Load a Blender scene, transparency composed onto white; see `load_scene`."""
    train, any_alpha = read_transforms(path, "transforms_train.json", data_factor)
    if (path / "transforms_test.json").is_file():
        test, _ = read_transforms(path, "transforms_test.json", data_factor)
        train, test = (sorted(views, key=lambda view: view.name) for views in (train, test))
    else:
        train, test = split_views(train, test_every)
    rng = np.random.default_rng(0)
    points = rng.uniform(-BOX, BOX, (init_num_pts, 3))
    rgb = rng.integers(0, 256, (init_num_pts, 3))
    background = WHITE if any_alpha else BLACK
    return assemble_scene(path, path.resolve().name, train, test, points, rgb, background)


def read_transforms(path: Path, file_name: str, data_factor: int) -> tuple[list[View], bool]:
    """Return the views of one transforms file and whether any image has transparency."""
    source = path / file_name
    try:
        content = json.loads(source.read_text())
        angle = float(content["camera_angle_x"])
        frames = [(str(f["file_path"]), np.array(f["transform_matrix"], dtype=np.float64)) for f in content["frames"]]
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{source} is not valid JSON ({error}); restore the file.") from error
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{source} lacks or garbles camera_angle_x, file_path or transform_matrix ({error}); restore the file."
        ) from error
    views, any_alpha = [], False
    for file_path, camera_to_world in frames:
        if camera_to_world.shape != (4, 4):
            raise InputError(f"{source}: transform_matrix of {file_path!r} is not 4x4; restore the file.")
        if not np.isfinite(camera_to_world).all() or abs(np.linalg.det(camera_to_world[:3, :3])) < 1e-6:
            raise InputError(f"{source}: transform_matrix of {file_path!r} is not a finite pose; restore the file.")
        image_path = find_image(path, file_path if Path(file_path).suffix else file_path + ".png")
        pixels, has_alpha = read_image(image_path, image_path, WHITE, data_factor)
        any_alpha |= has_alpha
        height, width = pixels.shape[:2]
        focal = 0.5 * width / math.tan(0.5 * angle)
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
        opencv = camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0])  # OpenGL looks along -z, y up
        viewmat = torch.from_numpy(np.linalg.inv(opencv)).float()
        views.append(View(image_path.relative_to(path).as_posix(), pixels, K, viewmat))
    if not views:
        raise InputError(f"{source} lists no frames; restore the file.")
    return views, any_alpha
