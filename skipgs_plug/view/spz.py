"""SPZ: the compressed format of Niantic that phones, glTF and web viewers read; about 20 bytes per Gaussian.

Files are written in version 2, which every reader knows. Versions 1 to 3 are read. Written from the description at
github.com/nianticlabs/spz. The axes of SPZ are right, up, back; the axes of a 3DGS model are right, down, front. So y
and z change their signs, and rotations and spherical harmonics change with them.
"""

from __future__ import annotations

import gzip
import logging
import math
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.compressed_ply import logits
from skipgs_plug.trainer.errors import InputError, reason
from skipgs_plug.trainer.ply import renderable, sh_degree

log = logging.getLogger(__name__)

MAGIC, VERSION = 0x5053474E, 2
HEADER = "<IIIBBBB"  # magic, version, Gaussians, SH degree, fractional bits of positions, flags, reserved
ANTIALIASED, EXTENDED = 1, 2  # flags
MOST = 10_000_000  # Gaussians in a file, at most: the authors' own reader refuses more
FARTHEST = 2**23 - 1  # largest coordinate, in units of the model: whole numbers of 24 bits with their sign
# Python's default, 9, writes 171,460 trained Gaussians in 3.7 s instead of 0.7 s, and the file is 1.6 % smaller.
GZIP_LEVEL = 6
COLOUR_SCALE = 0.15  # factor on constant SH coefficients before 0.5 is added, as the format says
HIGHEST_DEGREE = 3  # highest SH degree that is read, which is also the highest of this package's models
# Signs of the coefficients of bands 1 to 3 when y and z change sign: (y z x) (xy yz zz xz xx-yy) (...)
SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
SCALES = (-10.0, 255 / 16 - 10.0)  # logarithms of the scales that the bytes 0 and 255 stand for
FIRST_BAND_STEP, OTHER_BAND_STEP = 8, 16  # quantisation steps of 256 levels: five and four bits are left


class Spz(NamedTuple):
    """The content of a file."""

    splats: dict[str, Tensor]  # raw parameters, like the result of `read_ply`
    antialiased: bool  # whether opacities are compensated for the blur, as the model was trained


def to_spz(splats: Mapping[str, Tensor], antialiased: bool = False) -> bytes:
    """Return the file of a model with raw parameters like the result of `read_ply`.

    Positions are rounded to 2**-22 of the largest coordinate, but not finer than 2**-24. Opacities, colours, scales and
    rotations take one byte per number, spherical harmonics five bits in the first band and four bits in the others.

    Raises:
        InputError: A coordinate is larger than the format holds, 8,388,607 units, or there are too many Gaussians.
    """
    means, scales, colours = (splats[name].numpy().astype(np.float64) for name in ("means", "scales", "sh0"))
    if len(means) > MOST:
        raise InputError(f"A .spz holds {MOST:,} Gaussians, and this model has {len(means):,}; write a .ply or a .sog.")
    bits = fractional_bits(means)
    cut = int(((scales < SCALES[0]) | (scales > SCALES[1])).any(axis=1).sum())
    if cut:
        log.warning(
            "SPZ holds scales from e^%.0f to e^%.0f: the scales of %d Gaussians are cut. A .ply keeps them.",
            *SCALES,
            cut,
        )
    n, higher = len(means), splats["shN"].numpy().astype(np.float32)
    fixed = np.rint(means * (1.0, -1.0, -1.0) * 2.0**bits).astype("<i4")
    opacities = 255.0 / (1.0 + np.exp(-splats["opacities"].numpy().astype(np.float64)))
    quats = splats["quats"].numpy().astype(np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(min=1e-12)
    quats = np.where(quats[:, :1] < 0, -quats, quats)[:, 1:] * (1.0, -1.0, -1.0)
    parts = [
        struct.pack(HEADER, MAGIC, VERSION, n, sh_degree(higher.shape[1]), bits, ANTIALIASED * antialiased, 0),
        fixed.view(np.uint8).reshape(n, 3, 4)[..., :3].tobytes(),  # three bytes, the lowest first
        _bytes(opacities),
        _bytes((colours[:, 0] * COLOUR_SCALE + 0.5) * 255.0),
        _bytes((scales + 10.0) * 16.0),
        _bytes(quats * 127.5 + 127.5),
        _bytes(_harmonics(higher)),
    ]
    return gzip.compress(b"".join(parts), GZIP_LEVEL, mtime=0)


def position_error(means: Tensor) -> float:
    """Return the largest error by which coordinates of positions [N, 3] are rounded, in their units.

    Raises:
        InputError: A coordinate is larger than the format holds.
    """
    return 2.0 ** -(fractional_bits(means.numpy()) + 1)


def fractional_bits(means: np.ndarray) -> int:
    """Return how many bits of a coordinate are behind the point, 0 to 24: as many as the largest one leaves free.

    Raises:
        InputError: A coordinate is larger than the format holds.
    """
    largest = float(np.abs(means).max(initial=1e-9))
    if largest > FARTHEST:
        raise InputError(
            f"A .spz holds coordinates up to {FARTHEST:,}, and this model has {largest:,.0f}; write a .ply or a .sog."
        )
    return min(math.floor(math.log2(FARTHEST / largest)), 24)


def read_spz(path: Path) -> Spz:
    """Read a file of version 1 to 3.

    Raises:
        InputError: The file is damaged, of another version, or has unsupported content. The message says which.
    """
    data = path.read_bytes()
    if data[:4] == struct.pack("<I", MAGIC):
        raise InputError(f"{path} is an SPZ of version 4 or later; export it as version 3 or as PLY.")
    try:
        content = gzip.decompress(data)
        magic, version, n, degree, bits, flags, _ = struct.unpack_from(HEADER, content)
    except (OSError, EOFError, zlib.error, struct.error, MemoryError) as error:
        raise InputError(f"{path} is damaged or not an SPZ ({reason(error)}); export it again.") from error
    if magic != MAGIC or not 0 < n <= MOST:
        raise InputError(f"{path} is damaged or not an SPZ; export it again.")
    if version not in (1, 2, 3) or degree > HIGHEST_DEGREE or flags & EXTENDED:
        what = "extensions" if flags & EXTENDED else f"version {version} and SH degree {degree}"
        raise InputError(f"{path} is an SPZ with {what}, which is not read here; export it as PLY of degree 3 or less.")
    k = (degree + 1) ** 2 - 1
    sizes = (6 if version == 1 else 9, 1, 3, 3, 4 if version == 3 else 3, 3 * k)
    raw = np.frombuffer(content, np.uint8, offset=struct.calcsize(HEADER))
    if len(raw) != n * sum(sizes):
        raise InputError(f"{path} is damaged: {len(raw):,} bytes for {n:,} Gaussians; export it again.")
    means, alpha, colours, scales, quats, higher = np.split(raw, np.cumsum(sizes[:-1]) * n)
    values = {
        "means": _positions(means, bits, version).reshape(n, 3) * (1.0, -1.0, -1.0),
        "scales": scales.reshape(n, 3) / 16.0 - 10.0,
        "quats": (_smallest_three if version == 3 else _first_three)(quats.reshape(n, -1)) * (1.0, 1.0, -1.0, -1.0),
        "opacities": logits(alpha / 255.0),
        "sh0": ((colours.reshape(n, 3) / 255.0 - 0.5) / COLOUR_SCALE)[:, None],
        "shN": (higher.reshape(n, k, 3) / 128.0 - 1.0) * SH_SIGNS[:k, None],
    }
    splats = {name: torch.from_numpy(value.astype(np.float32)) for name, value in values.items()}
    return Spz(renderable(splats, path), bool(flags & ANTIALIASED))


def _positions(data: np.ndarray, bits: int, version: int) -> np.ndarray:
    if version == 1:
        return data.view("<f2").astype(np.float64)
    whole = data.reshape(-1, 3).astype(np.int64) @ np.array([1, 1 << 8, 1 << 16])
    return np.where(whole >= 1 << 23, whole - (1 << 24), whole) / 2.0**bits


def _first_three(data: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4] (wxyz) from three bytes [N, 3] for x, y and z."""
    xyz = data / 127.5 - 1.0
    return np.concatenate([np.sqrt((1.0 - (xyz**2).sum(axis=1, keepdims=True)).clip(0.0)), xyz], axis=1)


def _smallest_three(data: np.ndarray) -> np.ndarray:
    """Return quaternions [N, 4] (wxyz) from four bytes [N, 4]: ten bits for each component but the largest."""
    packed = np.ascontiguousarray(data).view("<u4")[:, 0]
    largest = packed >> np.uint32(30)
    parts = np.zeros((len(packed), 4))  # xyzw
    for i in (3, 2, 1, 0):  # the last component has the lowest bits
        held = largest != i
        size = (packed & np.uint32(511)) * (math.sqrt(0.5) / 511)
        parts[:, i] = np.where(held, np.where(packed & np.uint32(512), -size, size), 0.0)
        packed = np.where(held, packed >> np.uint32(10), packed)
    rows = np.arange(len(parts))
    parts[rows, largest] = np.sqrt((1.0 - (parts**2).sum(axis=1)).clip(0.0))
    return parts[:, [3, 0, 1, 2]]


def _harmonics(higher: np.ndarray) -> np.ndarray:
    """Quantise coefficients [N, K, 3] so that zero stays exact."""
    steps = np.where(np.arange(higher.shape[1]) < 3, FIRST_BAND_STEP, OTHER_BAND_STEP)[:, None]
    values = np.rint(higher * SH_SIGNS[: higher.shape[1], None] * 128.0) + 128.0
    return np.floor((values + steps / 2) / steps) * steps


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()
