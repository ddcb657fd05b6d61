"""The compressed PLY of SuperSplat and PlayCanvas, as columns of a plain 3DGS PLY."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from skipgs_plug.trainer.sh0 import sh0_of

CHUNK = 256  # Gaussians that share one set of bounds, as the format says
Columns = dict[str, np.ndarray]
MAX_LOGIT = 20.0  # opacity logit that stands for infinity in a file: its opacity is 1 in float32
XYZ, RGB = ("x", "y", "z"), ("r", "g", "b")
STEPS = (2047, 1023, 2047)  # steps of x, y and z from the lowest position of a chunk to its highest: 11, 10, 11 bits


def is_compressed(vertices: Mapping[str, np.ndarray]) -> bool:
    """Return whether `vertex` has the columns of a compressed PLY."""
    return {"packed_position", "packed_rotation", "packed_scale", "packed_color"} <= set(vertices)


def decompress(
    vertices: Mapping[str, np.ndarray], chunks: Mapping[str, np.ndarray], sh: Mapping[str, np.ndarray]
) -> Columns:
    """Return the columns `x` to `rot_3` [N] float32 from the elements `vertex` [N], `chunk` [ceil(N / 256)] and `sh`.

    Raises:
        KeyError: A column is missing.
        ValueError: There are too few chunks for the Gaussians.
    """
    packed = {
        name: np.asarray(vertices[f"packed_{name}"], dtype=np.uint32)
        for name in ("position", "rotation", "scale", "color")
    }
    n = len(packed["position"])
    chunk = np.arange(n) // CHUNK
    if n and len(chunks["min_x"]) <= chunk[-1]:
        raise ValueError(f"{len(chunks['min_x'])} chunks for {n} Gaussians")

    def between(values: np.ndarray, name: str) -> np.ndarray:
        low, high = (np.asarray(chunks[f"{end}_{name}"], dtype=np.float64)[chunk] for end in ("min", "max"))
        return low + values * (high - low)

    result: Columns = {}
    for axis, values in zip(XYZ, unpack_111011(packed["position"]), strict=True):
        result[axis] = between(values, axis)
    for i, values in enumerate(unpack_111011(packed["scale"])):
        result[f"scale_{i}"] = between(values, f"scale_{XYZ[i]}")
    for i, values in enumerate(unpack_rotation(packed["rotation"])):
        result[f"rot_{i}"] = values
    for i, name in enumerate(RGB):
        values = (packed["color"] >> np.uint32(24 - 8 * i) & np.uint32(255)) / 255.0
        colour = between(values, name) if f"min_{name}" in chunks else values
        result[f"f_dc_{i}"] = sh0_of(colour)
    result["opacity"] = logits((packed["color"] & np.uint32(255)) / 255.0)
    for name, values in sh.items():
        result[name] = (np.asarray(values, dtype=np.float64) + 0.5) / 256 * 8 - 4
    return {name: values.astype(np.float32) for name, values in result.items()}


def position_error(path: Path) -> float:
    """Return the largest error by which a file rounds coordinates between the bounds of their chunk, in their units."""
    from plyfile import PlyData

    chunks = PlyData.read(str(path))["chunk"]
    extents = [float((chunks[f"max_{axis}"] - chunks[f"min_{axis}"]).max(initial=0.0)) for axis in XYZ]
    return max(extent / steps / 2 for extent, steps in zip(extents, STEPS, strict=True))


def logits(alpha: np.ndarray) -> np.ndarray:
    """Return the logits of opacities in [0, 1] that were stored as bytes, finite at both ends."""
    with np.errstate(divide="ignore"):
        return (np.log(alpha) - np.log1p(-alpha)).clip(-MAX_LOGIT, MAX_LOGIT)  # type: ignore[no-any-return]


def unpack_111011(packed: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return three numbers in [0, 1] of 11, 10 and 11 bits."""
    x, y, z = packed >> np.uint32(21), packed >> np.uint32(11) & np.uint32(1023), packed & np.uint32(2047)
    return x / STEPS[0], y / STEPS[1], z / STEPS[2]


def unpack_rotation(packed: np.ndarray) -> list[np.ndarray]:
    """Return the four parts of unit quaternions. The file leaves out the largest one; 2 bits give its index."""
    bits = [packed >> np.uint32(shift) & np.uint32(1023) for shift in (20, 10, 0)]
    others = np.stack([(value / 1023.0 - 0.5) * np.sqrt(2.0) for value in bits])  # [3, N]
    largest = np.sqrt(np.maximum(1.0 - (others**2).sum(axis=0), 0.0))
    largest_at = packed >> np.uint32(30)
    parts = []
    for i in range(4):
        before = others[min(i, 2)]  # the largest component comes later
        after = others[max(i - 1, 0)]  # the largest component came earlier
        parts.append(np.where(largest_at == i, largest, np.where(largest_at > i, before, after)))
    return parts
