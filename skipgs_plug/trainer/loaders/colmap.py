"""COLMAP folders: sparse/0 or sparse, images, images_{factor}, masks."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.trainer.errors import InputError, MissingFileError, reason
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.colmap_files import check_lengths
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.paths import find_image
from skipgs_plug.trainer.loaders.photograph import PINHOLE_MODELS, find_mask, load_photograph, model_name
from skipgs_plug.trainer.loaders.undistorted_cache import UndistortedCache
from skipgs_plug.trainer.scene import Scene, View, assemble_scene, split_views

log = logging.getLogger(__name__)


def load_colmap(path: Path, data_factor: int, test_every: int, images: ImageStore) -> Scene:
    """Load a COLMAP reconstruction; see `load_scene`."""
    model = find_model(path)
    reconstruction = read_model(model)
    folder, factor = image_folder(path, data_factor)
    masks = path / "masks"
    cache = UndistortedCache(path)
    views, bare, distorted = [], 0, set()
    for image in images.reading(list(reconstruction.images.values())):
        if not image.has_pose:
            continue
        name = image_name(image, model)
        mask = find_mask(masks, name) if masks.is_dir() else None
        bare += mask is None
        camera = reconstruction.cameras[image.camera_id]
        if model_name(camera) not in PINHOLE_MODELS:
            distorted.add(model_name(camera))
        pose, image_path = pose_of(image, name, model), find_image(folder, name)
        views.append(load_photograph(name, image_path, camera, pose, cache, factor, mask, images))
    if not views:
        raise InputError(f"{model} registers no image; run COLMAP again with more overlap between photographs.")
    if distorted:
        log.warning("%s: lens distortion (%s) is removed, and the result kept.", path, ", ".join(sorted(distorted)))
    if masks.is_dir() and bare:
        log.warning("%s: %d of %d views have no mask there and count whole.", masks, bare, len(views))
    return assemble(path, model, views, reconstruction, test_every)


def assemble(path: Path, model: Path, views: list[View], reconstruction: Any, test_every: int) -> Scene:
    train, test = split_views(views, test_every)
    points = [reconstruction.points3D[i] for i in sorted(reconstruction.points3D)]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    rgb = np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)
    return assemble_scene(model, path.resolve().name, train, test, xyz, rgb)


def find_model(path: Path) -> Path:
    """Return the folder with cameras, images and points3D (.bin or .txt)."""
    tried = (path / "sparse" / "0", path / "sparse")
    for folder in tried:
        for suffix in (".bin", ".txt"):
            if all((folder / (stem + suffix)).is_file() for stem in ("cameras", "images", "points3D")):
                return folder
    raise MissingFileError(
        f"Neither {tried[0]} nor {tried[1]} holds cameras, images and points3D (.bin or .txt); run COLMAP's mapper."
    )


def read_model(model: Path) -> Any:
    """Read the reconstruction, turning pycolmap's failures into one sentence."""
    pycolmap = import_pycolmap()
    check_lengths(model, camera_models(pycolmap))
    try:
        return pycolmap.Reconstruction(str(model))
    except Exception as error:  # pycolmap raises bare RuntimeError, ValueError or IndexError by kind of damage
        raise InputError(f"COLMAP model {model} cannot be read ({reason(error)}); export it again.") from error


def camera_models(pycolmap: Any) -> dict[int, int]:
    """Return the number of parameters of each camera model by its id in files."""
    create = getattr(pycolmap.Camera, "create_from_model_id", pycolmap.Camera.create)  # create: before pycolmap 4
    models = [model for model in pycolmap.CameraModelId.__members__.values() if int(model) >= 0]
    return {int(model): len(create(1, model, 1.0, 2, 2).params) for model in models}


def image_name(image: Any, model: Path) -> str:
    try:
        return image.name
    except UnicodeDecodeError as error:
        raise InputError(f"{model} names image {image.image_id} in no UTF-8; rename the file and map again.") from error


def pose_of(image: Any, name: str, model: Path) -> np.ndarray:
    """Return world to camera [4, 4]."""
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
    viewmat = np.eye(4)
    viewmat[:3] = pose.matrix()
    length = np.linalg.norm(pose.rotation.quat)
    if not (np.isfinite(viewmat).all() and abs(length - 1) < 1e-3 and np.abs(viewmat).max() < 1e12):
        raise InputError(f"{model}: the pose of {name!r} is not one (quaternion of length {length:g}); map it again.")
    return viewmat


def image_folder(path: Path, data_factor: int) -> tuple[Path, int]:
    """Return the folder to read and the factor that is left to apply in memory."""
    full = path / "images"
    if data_factor > 1:
        reduced = path / f"images_{data_factor}"
        if reduced.is_dir():
            return reduced, 1
        if full.is_dir():
            log.warning("%s does not exist: resizing %s by %d in memory.", reduced, full, data_factor)
    if not full.is_dir():
        raise MissingFileError(f"Image folder {full} does not exist; put the photographs there.")
    return full, data_factor
