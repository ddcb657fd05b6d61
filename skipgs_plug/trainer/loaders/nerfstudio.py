"""nerfstudio folders: transforms.json with calibrated photographs, distorted or not, and a point cloud as PLY."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.camera_keys import read_camera, values_of
from skipgs_plug.trainer.loaders.json_file import opencv_viewmat, read_object, read_pose, read_string
from skipgs_plug.trainer.loaders.paths import find_image, find_images, inside, relative_name, subfolder
from skipgs_plug.trainer.loaders.photograph import PINHOLE_MODELS, find_mask, load_photograph, lost_angle, model_name
from skipgs_plug.trainer.loaders.undistorted_cache import UndistortedCache
from skipgs_plug.trainer.loaders.unused_files import warn_of_missing_masks, warn_of_unlisted_images
from skipgs_plug.trainer.ply import read_points
from skipgs_plug.trainer.scene import Scene, View, assemble_scene, split_views

log = logging.getLogger(__name__)

FILE = "transforms.json"
SPLITS = ("train_filenames", "val_filenames", "test_filenames")


def load_nerfstudio(
    path: Path,
    data_factor: int,
    test_every: int,
    images: ImageStore,
    cloud: tuple[np.ndarray, np.ndarray] | None,
) -> Scene:
    """Load transforms.json. `cloud` (points, colours) replaces its point cloud. See `load_scene` for the rest."""
    source = path / FILE
    content = read_object(source)
    frames = content.get("frames")
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames) or not frames:
        raise InputError(f"{source} lists no frames; run ns-process-data again.")
    cache = UndistortedCache(path)
    names = [read_string(frame.get("file_path"), "file_path of a frame", source) for frame in frames]
    names = [relative_name(path, name) for name in names]
    paths = find_images(path, names)
    masks = [mask_of(path, frame, name, source) for frame, name in zip(frames, names, strict=True)]
    views, distorted = [], set()
    for frame, name, full, mask in images.reading(list(zip(frames, names, paths, masks, strict=True))):
        viewmat = opencv_viewmat(read_pose(frame.get("transform_matrix"), name, source))
        camera = read_camera(values_of(content, frame), full, source)
        image_path, factor = reduced_image(path, full, data_factor)
        views.append(load_photograph(name, image_path, camera, viewmat, cache, factor, mask, images))
        if model_name(camera) not in PINHOLE_MODELS:
            distorted.add(model_name(camera) + lost_angle(camera, views[-1]))
    if distorted:
        log.warning("%s: lens distortion (%s) is removed; the result is cached.", source, ", ".join(sorted(distorted)))
    for folder in sorted({path / full.relative_to(path).parts[0] for full in paths} - set(paths)):
        warn_of_unlisted_images(folder, paths, f"frames of {FILE}")
    warn_of_missing_masks(subfolder(path, "masks"), masks)
    if len({repr(frame.get("time")) for frame in frames}) > 1:
        log.warning("%s: the frames have different times; objects that move will be blurred.", source)
    train, test = own_split(content, views, path, source) or split_views(views, test_every)
    points, colours = cloud or read_cloud(path, content, source)
    return assemble_scene(source, path.resolve().name, train, test, points, colours)


def mask_of(path: Path, frame: dict[str, Any], name: str, source: Path) -> Path | None:
    """Return the mask of a frame: its `mask_path`, else masks/x.png for images/x.jpg if that exists, else None."""
    given = frame.get("mask_path")
    if given is not None:
        return find_image(path, read_string(given, f"mask_path of {name!r}", source))
    masks, below = subfolder(path, "masks"), name.partition("/")[2]
    return find_mask(masks, below or name) if masks.is_dir() else None


def reduced_image(path: Path, full: Path, data_factor: int) -> tuple[Path, int]:
    """Return the image to read, and the factor by which it must still be reduced.

    For a factor of 4, images_4/x.png is read instead of images/x.png if the folder images_4 exists.
    """
    first, _, rest = full.relative_to(path).as_posix().partition("/")
    folder = path / f"{first}_{data_factor}"
    if data_factor > 1 and rest and folder.is_dir():
        return find_image(folder, rest), 1
    return full, data_factor


def own_split(
    content: dict[str, Any], views: list[View], path: Path, source: Path
) -> tuple[list[View], list[View]] | None:
    """Return training and held-out views as the file lists them; None if it lists no training views.

    The views of val_filenames and test_filenames are held out.
    """
    named: dict[str, set[str]] = {}
    for key in SPLITS:
        names = content.get(key)
        if names is None:
            continue
        if not isinstance(names, list):
            raise InputError(f"{source}: {key} is not a list of names; run ns-process-data again.")
        named[key] = {relative_name(path, read_string(name, key, source)) for name in names}
    if "train_filenames" not in named:
        return None
    held_out = named.get("val_filenames", set()) | named.get("test_filenames", set())
    unknown = (held_out | named["train_filenames"]) - {view.name for view in views}
    if unknown:
        raise InputError(
            f"{source}: its split names {min(unknown)!r}, which is not a frame; run ns-process-data again."
        )
    views = sorted(views, key=lambda view: view.name)
    train = [view for view in views if view.name in named["train_filenames"]]
    return train, [view for view in views if view.name in held_out - named["train_filenames"]]


def read_cloud(path: Path, content: dict[str, Any], source: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return points and colours of `ply_file_path`, or of sparse_pc.ply. nerfstudio gives them in the poses' frame."""
    name = content.get("ply_file_path")
    if name is None and os.path.isfile(path / "sparse_pc.ply"):
        name = "sparse_pc.ply"
    if name is None:
        raise InputError(f"{source} names no ply_file_path; run ns-process-data again or give --init-ply.")
    return read_points(inside(path, read_string(name, "ply_file_path", source)))
