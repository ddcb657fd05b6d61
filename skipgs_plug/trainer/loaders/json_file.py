"""JSON files of a scene, whose values are checked: each error is one sentence about the file."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from skipgs_plug.trainer.errors import InputError, reason

ROUNDED = 1e-3  # difference of an axis' length from 1 that rounding to few digits explains
SHEARED = 0.02  # cosine of two axes, at least, that rounding cannot explain: the pose is refused


def read_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file: UTF-8 whatever the locale, or UTF-16, as PowerShell writes it.

    Raises:
        InputError: The file cannot be read, is not JSON, is nested too deeply, or does not hold an object.
    """
    try:
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{path} is not valid JSON ({reason(error)}); restore the file.") from error
    if not isinstance(content, dict):
        raise InputError(f"{path} holds no JSON object; restore the file.")
    return content


def read_number(value: Any, name: str, source: Path) -> float:
    """Return a finite number; raise InputError for another value."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if isinstance(value, (str, bool)) or not math.isfinite(number):
        raise InputError(f"{source}: {name} is {short(value)}, not a finite number; restore the file.")
    return number


def read_string(value: Any, name: str, source: Path) -> str:
    if not isinstance(value, str):
        raise InputError(f"{source}: {name} is {short(value)}, not a string; restore the file.")
    return value


def read_pose(value: Any, name: str, source: Path) -> np.ndarray:
    """Return a camera-to-world matrix [4, 4] of a rotation and a position.

    Three rows stand for four. The size of a camera object, which 3D programs export with its pose, is taken out.

    Raises:
        InputError: The value is not a pose; the message says why.
    """
    try:
        pose = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{source}: transform_matrix of {name!r} is not 4x4 numbers; restore the file.") from error
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise InputError(f"{source}: transform_matrix of {name!r} is not 4x4; restore the file.")
    sound = np.isfinite(pose).all() and np.abs(pose).max() < 1e12 and np.allclose(pose[3], (0, 0, 0, 1))
    if not sound or abs(np.linalg.det(pose[:3, :3])) < 1e-6:
        raise InputError(f"{source}: transform_matrix of {name!r} is not a finite pose; restore the file.")
    sizes = np.linalg.norm(pose[:3, :3], axis=0)
    if np.abs(sizes - 1.0).max() > ROUNDED:
        pose[:3, :3] /= sizes
    if np.abs(pose[:3, :3].T @ pose[:3, :3] - np.eye(3)).max() > SHEARED:
        raise InputError(
            f"{source}: the axes of transform_matrix of {name!r} are not at right angles; export it again."
        )
    if np.linalg.det(pose[:3, :3]) < 0:
        raise InputError(
            f"{source}: transform_matrix of {name!r} is a mirror image; export it with right-handed axes (x right, y "
            "up, looking along -z)."
        )
    return pose


def opencv_viewmat(camera_to_world: np.ndarray) -> np.ndarray:
    """Return world to camera [4, 4] of an OpenGL pose, which looks along -z with y up."""
    return np.linalg.inv(camera_to_world @ np.diag([1.0, -1.0, -1.0, 1.0]))


def short(value: Any) -> str:
    """Return a wrong value in at most 60 characters; a number with thousands of digits cannot be printed."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "too long"
    return text if len(text) <= 60 else text[:57] + "..."
