"""One View of a photograph, its mask and its calibrated camera, without lens distortion."""

from __future__ import annotations

import math
import os
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.errors import InputError, reason
from skipgs_plug.trainer.image_store import ImageStore
from skipgs_plug.trainer.loaders.images import read_image, read_mask
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.paths import inside, look_up
from skipgs_plug.trainer.loaders.undistorted_cache import Straight, UndistortedCache
from skipgs_plug.trainer.scene import View

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE")
MAX_SIDE = 1 << 20  # most pixels along a side: a larger number comes from a damaged file


def load_photograph(
    name: str,
    image_path: Path,
    camera: Any,
    viewmat: np.ndarray,
    cache: UndistortedCache,
    factor: int,
    mask_path: Path | None,
    images: ImageStore,
) -> View:
    """Read a photograph. Alpha below one half and black pixels of the mask do not count in the loss.

    Args:
        name: Name of the view.
        image_path: The photograph, at any scale of the size that the camera was calibrated for.
        camera: pycolmap.Camera of any model that pycolmap can undistort.
        viewmat: World to camera [4, 4].
        cache: Keeps undistorted photographs.
        factor: Factor by which the photograph is reduced in memory.
        mask_path: Picture of the same shape, black where pixels are left out; None without a mask.
        images: Store for the photograph.
    """
    check_camera(camera, image_path)

    def read() -> Straight:
        return read_straight(image_path, camera, cache, factor, mask_path)

    pixels, mask, K = read()
    view = View(name, pixels, torch.from_numpy(K), torch.from_numpy(viewmat), mask)
    return images.keep(view, lambda: read()[:2])


def read_straight(
    image_path: Path, camera: Any, cache: UndistortedCache, factor: int, mask_path: Path | None
) -> Straight:
    """Return a photograph without lens distortion; see `load_photograph`."""
    if model_name(camera) in PINHOLE_MODELS:
        pixels, mask = read_photograph(image_path, camera, factor, mask_path)
        K = scaled_matrix(camera, pixels)
    else:
        key = cache.key(image_path, mask_path, camera, factor)
        kept = cache.read(key)
        if kept is None:
            kept = undistort(*read_photograph(image_path, camera, factor, mask_path), camera, image_path)
            cache.write(key, kept)
        return kept
    return Straight(pixels, mask, K)


def scaled_matrix(camera: Any, pixels: Tensor) -> np.ndarray:
    """Return the calibration matrix [3, 3] float64 of a pinhole camera for the size of `pixels` [H, W, 3]."""
    K = np.array(camera.calibration_matrix(), dtype=np.float64)
    # The reduced image has a rounded size: scale by the loaded size, not by the factor.
    K[0] *= pixels.shape[1] / camera.width
    K[1] *= pixels.shape[0] / camera.height
    return K


def read_photograph(image_path: Path, camera: Any, factor: int, mask_path: Path | None) -> tuple[Tensor, Tensor | None]:
    """Return pixels [H, W, 3] and mask [H, W], with lens distortion."""
    size = (camera.width, camera.height)
    pixels, alpha = read_image(image_path, image_path, None, factor, size)
    mask = None if alpha is None else alpha >= 128
    if mask_path is not None:
        drawn = read_mask(mask_path, pixels, size)
        mask = drawn if mask is None else mask & drawn
    return pixels, mask


def lost_angle(camera: Any, view: View) -> str:
    """Return a clause about the lost part of a wide lens in `view`; empty if it is less than a tenth.

    The lens counts as an equidistant fisheye, which its distortion changes little.
    """
    if "FISHEYE" not in model_name(camera):
        return ""
    whole = math.degrees(camera.width / float(np.array(camera.params)[list(camera.focal_length_idxs())][0]))
    kept = math.degrees(2 * math.atan(view.width / 2 / float(view.K[0, 0])))
    return f", {kept:.0f} of about {whole:.0f} degrees are kept" if kept < 0.9 * whole else ""


def undistort(pixels: Tensor, mask: Tensor | None, camera: Any, image_path: Path) -> Straight:
    """Resample image and mask for a pinhole camera, cropped so that every pixel has a source."""
    pycolmap = import_pycolmap()
    try:
        fitted = pycolmap.Camera(camera.todict())
        fitted.rescale(pixels.shape[1], pixels.shape[0])
        options = pycolmap.UndistortCameraOptions()
        bitmap, pinhole = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(pixels.numpy()), fitted)
        K = np.array(pinhole.calibration_matrix(), dtype=np.float64)  # fails for a camera that sees a sphere
        straight = torch.from_numpy(np.array(bitmap.to_array()))
        if mask is not None:
            drawn = pycolmap.Bitmap.from_array(mask.byte().numpy() * 255)
            cut, _ = pycolmap.undistort_image(options, drawn, fitted)
            mask = torch.from_numpy(np.array(cut.to_array())).reshape(straight.shape[:2]) >= 128
    except Exception as error:  # pycolmap raises bare RuntimeError or ValueError
        raise InputError(
            f"Image {image_path}: its camera, a {model_name(camera)}, cannot be undistorted ({reason(error)}); "
            "run: colmap image_undistorter."
        ) from error
    return Straight(straight, mask, K)


def check_camera(camera: Any, source: Path) -> None:
    """Refuse impossible sizes, focal lengths and distortions."""
    parameters = np.array(camera.params, dtype=np.float64)
    focal = parameters[list(camera.focal_length_idxs())]
    if not (0 < camera.width <= MAX_SIDE and 0 < camera.height <= MAX_SIDE):
        problem = f"a size of {camera.width}x{camera.height}"
    elif not np.isfinite(parameters).all() or np.abs(parameters).max(initial=0.0) > 1e9:
        problem = f"parameters {parameters.tolist()}"
    elif (focal <= 0).any():
        problem = f"a focal length of {focal.min():g}"
    else:
        return
    raise InputError(f"{source}: its camera ({model_name(camera)}) has {problem}; run the reconstruction again.")


def model_name(camera: Any) -> str:
    return getattr(camera.model, "name", str(camera.model))


def find_mask(folder: Path, name: str) -> Path | None:
    """Return the mask of an image: its name with .png added (like COLMAP), or its name with any image suffix."""
    path = inside(folder, name)
    added = path.with_name(path.name + ".png")
    return added if os.path.isfile(added) else look_up(folder, PurePosixPath(path.relative_to(folder).as_posix()))
