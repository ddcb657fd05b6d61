"""COLMAP folders: sparse/0 or sparse, images, images_{factor}."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError, MissingFileError
from skipgs_plug.trainer.images import find_image, read_image
from skipgs_plug.trainer.scene import BLACK, Scene, View, assemble_scene, split_views

log = logging.getLogger(__name__)

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")


def load_colmap(path: Path, data_factor: int, test_every: int) -> Scene:
    """Load a COLMAP reconstruction with pinhole cameras; see `load_scene`."""
    model = find_model(path)
    reconstruction = read_model(model)
    folder, factor = image_folder(path, data_factor)
    views = []
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        pixels, _ = read_image(find_image(folder, image.name), folder / image.name, BLACK, factor)
        camera = reconstruction.cameras[image.camera_id]
        K = pinhole_matrix(camera, model)
        # The downscaled image has a rounded size: scale by what was really loaded, not by the factor.
        K[0] *= pixels.shape[1] / camera.width
        K[1] *= pixels.shape[0] / camera.height
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        viewmat = np.eye(4)
        viewmat[:3] = pose.matrix()
        views.append(View(image.name, pixels, torch.from_numpy(K).float(), torch.from_numpy(viewmat).float()))
    if not views:
        raise InputError(f"{model} registers no image; run COLMAP again with more overlap between photographs.")
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
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(f"Reading COLMAP folders needs pycolmap; run: {install_command()}.") from error
    try:
        return pycolmap.Reconstruction(str(model))
    except Exception as error:  # pycolmap raises bare RuntimeError, ValueError or IndexError by kind of damage
        raise InputError(f"COLMAP model {model} cannot be read ({error}); export it again.") from error


def pinhole_matrix(camera: Any, model: Path) -> np.ndarray:
    """Return K [3, 3] in pixels of the size COLMAP saw, or name the model that is not supported."""
    kind = getattr(camera.model, "name", str(camera.model))
    if kind not in PINHOLE_MODELS:
        raise InputError(
            f"Camera {camera.camera_id} of {model} has model {kind}, only {' and '.join(PINHOLE_MODELS)} are "
            "supported; run: colmap image_undistorter."
        )
    return np.array(camera.calibration_matrix(), dtype=np.float64)


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
