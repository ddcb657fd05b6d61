"""SPZ, version 2: the compressed format of Niantic that phones, glTF and web viewers read; about 20 bytes per Gaussian.

Written from the description at github.com/nianticlabs/spz. Its axes are right, up, back; those of a 3DGS model are
right, down, front, so y and z change their signs, and with them rotations and spherical harmonics.
"""

from __future__ import annotations

import gzip
import math
import struct
from collections.abc import Mapping

import numpy as np
from torch import Tensor

MAGIC, VERSION = 0x5053474E, 2
POSITION_BITS = 23  # and a sign
COLOUR_SCALE = 0.15  # of the constant coefficients around one half, in bytes
DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}  # by number of coefficients beyond the constant one
# Signs of the coefficients of bands 1 to 3 when y and z are turned: (y z x) (xy yz zz xz xx-yy) (...)
SH_SIGNS = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], dtype=np.float32)
FIRST_BAND_STEP, OTHER_BAND_STEP = 8, 16  # of 256: five and four bits


def to_spz(splats: Mapping[str, Tensor]) -> bytes:
    """Return the file of a model with raw parameters, as of `read_ply`.

    Positions are kept to 2**-22 of the largest coordinate, but not finer than 2**-24; opacities, colours, scales and
    rotations in a byte each; spherical harmonics in five bits for the first band and four for the others.
    """
    means, scales, colours = (splats[name].numpy().astype(np.float64) for name in ("means", "scales", "sh0"))
    n, rest = len(means), splats["shN"].numpy().astype(np.float32)
    largest = float(np.abs(means).max(initial=1e-9))
    bits = min(max(math.floor(math.log2((2**POSITION_BITS - 1) / largest)), 0), 24)
    fixed = np.rint(means * (1.0, -1.0, -1.0) * 2.0**bits).astype("<i4")
    fixed = fixed.clip(-(2**POSITION_BITS), 2**POSITION_BITS - 1)
    opacities = 255.0 / (1.0 + np.exp(-splats["opacities"].numpy().astype(np.float64)))
    quats = splats["quats"].numpy().astype(np.float64)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True).clip(min=1e-12)
    quats = np.where(quats[:, :1] < 0, -quats, quats)[:, 1:] * (1.0, -1.0, -1.0)
    parts = [
        struct.pack("<IIIBBBB", MAGIC, VERSION, n, DEGREES[rest.shape[1]], bits, 0, 0),
        fixed.view(np.uint8).reshape(n, 3, 4)[..., :3].tobytes(),  # three bytes, the lowest first
        _bytes(opacities),
        _bytes((colours[:, 0] * COLOUR_SCALE + 0.5) * 255.0),
        _bytes((scales + 10.0) * 16.0),
        _bytes(quats * 127.5 + 127.5),
        _bytes(_harmonics(rest)),
    ]
    return gzip.compress(b"".join(parts), mtime=0)


def _harmonics(rest: np.ndarray) -> np.ndarray:
    """Quantise coefficients [N, K, 3] so that zero stays exact."""
    steps = np.where(np.arange(rest.shape[1]) < 3, FIRST_BAND_STEP, OTHER_BAND_STEP)[:, None]
    values = np.rint(rest * SH_SIGNS[: rest.shape[1], None] * 128.0) + 128.0
    return np.floor((values + steps / 2) / steps) * steps


def _bytes(values: np.ndarray) -> bytes:
    return np.rint(values).clip(0, 255).astype(np.uint8).tobytes()
