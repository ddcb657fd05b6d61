"""Cameras in transforms.json, with the keys of instant-ngp, nerfstudio and exporters for Blender."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.loaders.images import read_image
from skipgs_plug.trainer.loaders.json_file import read_number, short
from skipgs_plug.trainer.loaders.native import import_pycolmap
from skipgs_plug.trainer.loaders.photograph import MAX_SIDE

PERSPECTIVE = ("PERSPECTIVE", "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
FISHEYE = ("OPENCV_FISHEYE", "FISHEYE")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
FOCAL = (
    "fl_x",
    "fl_y",
    "camera_angle_x",
    "camera_angle_y",
    "x_fov",
    "y_fov",
)  # alternative ways to give a focal length
NUMBERS = ("w", "h", "cx", "cy", *FOCAL, *DISTORTION)
UNDISTORT = "undistort the images"
ALPHA = "write transparency as the alpha channel of the images"
# Keys that change a picture and are not modelled, with meaning and cure. They are refused unless zero, false or empty.
UNSUPPORTED = {
    **dict.fromkeys(
        ("k5", "k6", "p3", "p4", "b1", "b2", "s1", "s2", "s3", "s4", "skew", "shear", "distortion_params"),
        ("this distortion", UNDISTORT),
    ),
    **dict.fromkeys(("ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4"), ("the f-theta lens", UNDISTORT)),
    **dict.fromkeys(("latlong", "is_equirectangular", "is_latlong"), ("a panorama", "cut it into pinhole images")),
    **dict.fromkeys(("is_orthographic", "ortho_scale"), ("a parallel projection", "render a perspective one")),
    "rolling_shutter": ("a rolling shutter", UNDISTORT),
    **dict.fromkeys(("white_transparent", "black_transparent", "mask_color"), ("transparency by colour", ALPHA)),
    **dict.fromkeys(("from_mitsuba", "normal_mts_args"), ("the axes of Mitsuba", "export with those of Blender")),
}


def values_of(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """Return the keys of a frame: its own, and keys of the file that the frame does not override."""
    shared = content
    if any(frame.get(key) is not None for key in FOCAL):
        shared = {key: value for key, value in content.items() if key not in FOCAL}
    return {**shared, **{key: value for key, value in frame.items() if value is not None}}


def read_camera(values: dict[str, Any], image_path: Path, source: Path) -> Any:
    """Return the pycolmap.Camera that a frame (its own values over those of the file) describes.

    Focal lengths come from `x_fov` and `y_fov` (degrees), `fl_x` and `fl_y` (pixels) or `camera_angle_x` and
    `camera_angle_y` (radians), in this order, as in instant-ngp. A value for one axis counts for both.

    Raises:
        InputError: The model is neither a pinhole nor OpenCV's (fisheye) lens, there is no focal length, or a key
            changes the picture in a way that is not modelled.
    """
    refuse_unsupported(values, source)
    numbers = {name: read_number(values[name], name, source) for name in NUMBERS if values.get(name) is not None}
    if not {"w", "h"} <= numbers.keys():
        pixels, _ = read_image(image_path, image_path)
        rows, columns = pixels.shape[:2]
        numbers["h"], numbers["w"] = rows, columns
        if numbers.get("cx", 0) >= columns or numbers.get("cy", 0) >= rows:  # they were given for larger photographs
            raise InputError(
                f"{source}: cx and cy lie outside {image_path.name} ({columns}x{rows} pixels), and w and h are "
                "missing; add the w and h for which fl_x and cx were given."
            )
    width, height = numbers["w"], numbers["h"]
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width == int(width) and height == int(height)):
        raise InputError(
            f"{source}: w and h are {width:g} and {height:g}, which is not an image size; restore the file."
        )
    focal_x, focal_y = focal_length(numbers, "x", width, source), focal_length(numbers, "y", height, source)
    if focal_x is None and focal_y is None:
        raise InputError(
            f"{source}: {image_path.name} has neither fl_x nor camera_angle_x nor x_fov, nor these of y; "
            "run ns-process-data again."
        )
    pinhole = [
        focal_y if focal_x is None else focal_x,
        focal_x if focal_y is None else focal_y,
        numbers.get("cx", width / 2),
        numbers.get("cy", height / 2),
    ]
    k1, k2, k3, k4, p1, p2 = (numbers.get(name, 0.0) for name in DISTORTION)
    kind = values.get("camera_model", "PERSPECTIVE")
    if values.get("is_fisheye") and kind in PERSPECTIVE:
        kind = FISHEYE[0]
    if kind in FISHEYE:
        if p1 or p2:
            raise InputError(f"{source}: a fisheye lens with p1 or p2 is not supported; undistort the images.")
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


def focal_length(numbers: dict[str, float], axis: str, side: float, source: Path) -> float | None:
    """Return the focal length in pixels along an axis whose picture has `side` pixels, or None."""
    for key, half in ((f"{axis}_fov", math.pi / 360), (f"fl_{axis}", None), (f"camera_angle_{axis}", 0.5)):
        if key not in numbers:
            continue
        value = numbers[key]
        if half is None:
            return value
        if not 0.0 < value * half < math.pi / 2:
            limit = "pi" if half == 0.5 else "180"
            raise InputError(f"{source}: {key} is {value:g}, not between 0 and {limit}; restore the file.")
        return 0.5 * side / math.tan(value * half)
    return None


def refuse_unsupported(values: dict[str, Any], source: Path) -> None:
    """Raise InputError for a key that changes the picture and is not modelled."""
    for key, (what, cure) in UNSUPPORTED.items():
        value = values.get(key)
        parts = value if isinstance(value, list) else [value]
        if any(parts):
            raise InputError(f"{source}: {key} is {short(value)}, and {what} is not supported; {cure}.")
    start, end = values.get("transform_matrix_start"), values.get("transform_matrix_end")
    if start != end:
        raise InputError(
            f"{source}: a camera that moves during the exposure (transform_matrix_start, _end) is not supported."
        )
