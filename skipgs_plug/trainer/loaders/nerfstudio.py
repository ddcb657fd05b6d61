"""nerfstudio folders: transforms.json with calibrated photographs, perhaps distorted, and a point cloud as PLY."""

from __future__ import annotations

import logging
import math
import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.blender import opencv_viewmat
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.json_file import read_number, read_object, read_pose, read_string
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.paths import find_image, inside
from skipgs_plug.trainer.loaders.photograph import MAX_SIDE, PINHOLE_MODELS, load_photograph, model_name
from skipgs_plug.trainer.loaders.undistorted_cache import UndistortedCache
from skipgs_plug.trainer.ply import read_points
from skipgs_plug.trainer.scene import Scene, View, assemble_scene, split_views

log = logging.getLogger(__name__)

FILE = "transforms.json"
PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
SPLITS = ("train_filenames", "val_filenames", "test_filenames")


def load_nerfstudio(
    path: Path,
    data_factor: int,
    test_every: int,
    images: ImageStore,
    cloud: tuple[np.ndarray, np.ndarray] | None = None,
) -> Scene:
    """Load transforms.json; `cloud` (points, colours) takes the place of its point cloud. See `load_scene`."""
    source = path / FILE
    content = read_object(source)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise InputError(f"{source} lists no frames; run ns-process-data again.")
    cache = UndistortedCache(path)
    views, distorted = [], set()
    for frame in images.reading(frames):
        file_path = read_string(frame.get("file_path"), "file_path of a frame", source)
        name = PurePosixPath(file_path).as_posix()  # without a leading ./
        viewmat = opencv_viewmat(read_pose(frame.get("transform_matrix"), file_path, source))
        full = find_image(path, name)
        camera = read_camera({**content, **frame}, full, source)
        mask = frame.get("mask_path")
        if mask is not None:
            mask = inside(path, read_string(mask, f"mask_path of {name!r}", source))
        image_path, factor = reduced_image(path, name, full, data_factor)
        views.append(load_photograph(name, image_path, camera, viewmat, cache, factor, mask, images))
        if model_name(camera) not in PINHOLE_MODELS:
            distorted.add(model_name(camera))
    if distorted:
        log.warning("%s: lens distortion (%s) is removed, and the result kept.", source, ", ".join(sorted(distorted)))
    train, test = own_split(content, views, source) or split_views(views, test_every)
    points, colours = cloud or read_cloud(path, content, source)
    return assemble_scene(source, path.resolve().name, train, test, points, colours)


def read_camera(values: dict[str, Any], image_path: Path, source: Path) -> Any:
    """Return the pycolmap.Camera that a frame (its own values over those of the file) describes.

    Raises:
        InputError: a model that is neither a pinhole nor OpenCV's (fisheye) lens, or without a focal length.
    """
    numbers = {
        name: read_number(values[name], name, source)
        for name in ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", *DISTORTION)
        if values.get(name) is not None
    }
    if not {"w", "h"} <= numbers.keys():
        pixels, _ = read_image(image_path, image_path)
        numbers["h"], numbers["w"] = pixels.shape[:2]
    width, height = numbers["w"], numbers["h"]
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width == int(width) and height == int(height)):
        raise InputError(f"{source}: w and h are {width:g} and {height:g}, no size of an image; restore the file.")
    if "fl_x" not in numbers and 0 < numbers.get("camera_angle_x", 0) < math.pi:
        numbers["fl_x"] = 0.5 * width / math.tan(0.5 * numbers["camera_angle_x"])
    if "fl_x" not in numbers:
        raise InputError(f"{source}: {image_path.name} has neither fl_x nor camera_angle_x; run ns-process-data again.")
    pinhole = [
        numbers["fl_x"],
        numbers.get("fl_y", numbers["fl_x"]),
        numbers.get("cx", width / 2),
        numbers.get("cy", height / 2),
    ]
    kind = values.get("camera_model", "PERSPECTIVE")
    k1, k2, k3, k4, p1, p2 = (numbers.get(name, 0.0) for name in DISTORTION)
    if kind in FISHEYE:
        model, parameters = "OPENCV_FISHEYE", [*pinhole, k1, k2, k3, k4]
    elif kind not in PERSPECTIVE or k4:
        raise InputError(
            f"{source}: camera_model {kind!r}{' with k4' if k4 else ''} is not supported, only "
            f"{', '.join(PERSPECTIVE + FISHEYE)} (fourth radial coefficient for fisheye alone); undistort the images."
        )
    elif k3:
        model, parameters = "FULL_OPENCV", [*pinhole, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    elif k1 or k2 or p1 or p2:
        model, parameters = "OPENCV", [*pinhole, k1, k2, p1, p2]
    else:
        model, parameters = "PINHOLE", pinhole
    camera = {"model": model, "width": int(width), "height": int(height), "params": parameters}
    return import_pycolmap().Camera(camera)


def reduced_image(path: Path, name: str, full: Path, data_factor: int) -> tuple[Path, int]:
    """Return the image to read and the factor that is left: images_4/x.png for images/x.png where it exists."""
    first, _, rest = name.partition("/")
    folder = path / f"{first}_{data_factor}"
    if data_factor > 1 and rest and folder.is_dir():
        return find_image(folder, rest), 1
    return full, data_factor


def own_split(content: dict[str, Any], views: list[View], source: Path) -> tuple[list[View], list[View]] | None:
    """Return training and held-out views as the file lists them (val_filenames and test_filenames are held out)."""
    named: dict[str, set[str]] = {}
    for key in SPLITS:
        names = content.get(key)
        if names is None:
            continue
        if not isinstance(names, list):
            raise InputError(f"{source}: {key} is not a list of names; run ns-process-data again.")
        named[key] = {PurePosixPath(read_string(name, key, source)).as_posix() for name in names}
    if "train_filenames" not in named:
        return None
    held_out = named.get("val_filenames", set()) | named.get("test_filenames", set())
    unknown = (held_out | named["train_filenames"]) - {view.name for view in views}
    if unknown:
        raise InputError(f"{source}: its split names {min(unknown)!r}, which is no frame; run ns-process-data again.")
    views = sorted(views, key=lambda view: view.name)
    train = [view for view in views if view.name in named["train_filenames"]]
    return train, [view for view in views if view.name in held_out - named["train_filenames"]]


def read_cloud(path: Path, content: dict[str, Any], source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours of `ply_file_path`, in the frame of the poses as nerfstudio has it."""
    name = content.get("ply_file_path")
    if name is None and os.path.isfile(path / "sparse_pc.ply"):
        name = "sparse_pc.ply"
    if name is None:
        raise InputError(f"{source} names no ply_file_path; run ns-process-data again or give --init-ply.")
    return read_points(inside(path, read_string(name, "ply_file_path", source)))
