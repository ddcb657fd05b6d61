"""Procedural colours of the demo scene: position [3, R] in, RGB [3, R] out."""

from __future__ import annotations

import numpy as np

Array = np.ndarray
PRIMES = 374761393, 668265263, 2147483647  # factors of the lattice's hash, one per axis


def mix(a: tuple[float, ...], b: tuple[float, ...], weight: Array) -> Array:
    return np.array(a)[:, None] * (1 - weight) + np.array(b)[:, None] * weight


def value_noise(points: Array, frequency: float) -> Array:
    """Return smooth pseudo-random values [R] in [0, 1] from a hashed lattice."""
    scaled = points * frequency
    floor = np.floor(scaled)
    fraction = scaled - floor
    fraction = fraction * fraction * (3 - 2 * fraction)
    weights = 1 - fraction, fraction  # weights of the lower and the upper corner along each axis
    hashes = floor.astype(np.int64) * np.array(PRIMES)[:, None]
    total = np.zeros(points.shape[1])
    for i, j, k in np.ndindex(2, 2, 2):
        weight = weights[i][0] * weights[j][1] * weights[k][2]
        key = hashes[0] + hashes[1] + hashes[2] + (i * PRIMES[0] + j * PRIMES[1] + k * PRIMES[2])
        key = (key ^ (key >> 13)) * 1274126177
        total += weight * ((key >> 8) & 1023) / 1023.0
    return total


def tiles(p: Array) -> Array:
    checker = (np.floor(p[0] / 0.4) + np.floor(p[1] / 0.4)) % 2
    base = mix((0.78, 0.74, 0.66), (0.32, 0.40, 0.46), checker)
    return base * (0.7 + 0.4 * value_noise(p, 5.0) * value_noise(p, 11.0) + 0.15 * value_noise(p, 23.0))


def bricks(p: Array) -> Array:
    along, row = (p[0] + p[1]) / 0.24, p[2] / 0.12
    shifted = along + 0.5 * (np.floor(row) % 2)
    mortar = ((shifted % 1) < 0.09) | ((row % 1) < 0.16)
    colour = mix((0.66, 0.26, 0.19), (0.80, 0.42, 0.27), value_noise(p, 7.0))
    return np.where(mortar, 0.82, colour)


def stripes(p: Array) -> Array:
    wave = np.sin(26 * p[2] + 3 * np.sin(5 * p[0]))
    return mix((0.12, 0.36, 0.62), (0.92, 0.90, 0.82), (wave > 0).astype(float))


def noise(p: Array) -> Array:
    return mix((0.10, 0.42, 0.24), (0.86, 0.82, 0.30), value_noise(p, 6.0) * 0.6 + value_noise(p, 17.0) * 0.4)


def gold(p: Array) -> Array:
    return np.repeat(np.array((0.83, 0.68, 0.38))[:, None], p.shape[1], axis=1)


TEXTURES = {"tiles": tiles, "bricks": bricks, "stripes": stripes, "noise": noise, "gold": gold}
