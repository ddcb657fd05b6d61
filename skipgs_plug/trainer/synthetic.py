"""The demo scene, ray traced in numpy, so that its ground truth does not depend on a splat rasterizer.

A textured floor, two textured boxes, a matte and a mirroring sphere, seen from cameras on a dome. Points on the
surfaces replace points from structure from motion.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from skipgs_plug.trainer.raytrace import (
    BOXES,
    EPS,
    FIRST_BOX,
    FLOOR,
    FLOOR_HALF,
    SKY,
    SPHERES,
    Array,
    lit_albedo,
    trace_view,
)
from skipgs_plug.trainer.scene import Scene, View, assemble_scene

RADIUS = 3.6  # distance of each camera from the middle; the floor is 5.2 wide and fills most of the picture
FOV_X = np.deg2rad(52.0)  # horizontal angle of view in radians, at which the floor fills most of the picture


def make_scene(
    n_views: int = 48,
    width: int = 160,
    height: int = 120,
    n_points: int = 4000,
    test_every: int = 8,
) -> Scene:
    """Ray-trace a small scene with 2x2 samples per pixel. The same arguments give the same scene.

    Args:
        n_views: Number of cameras. They are spread evenly over a dome (golden angle).
        width: Image width in pixels.
        height: Image height in pixels.
        n_points: Number of surface points, with the colour of their texture under the light.
        test_every: Hold out every n-th view by name.

    Examples:
        >>> from skipgs_plug.trainer.synthetic import make_scene
        >>> scene = make_scene(n_views=10, width=32, height=24, n_points=160)
        >>> len(scene.train), len(scene.test)
        (8, 2)
    """
    focal = 0.5 * width / np.tan(0.5 * FOV_X)
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    train: list[View] = []
    test: list[View] = []
    for i in range(n_views):
        viewmat = look_at(dome_position(i, n_views), np.array([0.0, 0.0, 0.35]))
        image = trace_view(viewmat, K, width, height)
        view = View(
            f"view_{i:03d}.png",
            torch.from_numpy(np.rint(image * 255).astype(np.uint8)),
            torch.from_numpy(K),
            torch.from_numpy(viewmat),
        )
        (test if test_every and i % test_every == 0 else train).append(view)
    points, colours = sample_surfaces(n_points, np.random.default_rng(0))
    rgb = np.rint(colours * 255).astype(np.uint8)
    return assemble_scene(Path("demo"), "demo", train, test, points, rgb, background=SKY)


def dome_position(i: int, n: int) -> Array:
    """Return camera i of n on the dome, 18 to 62 degrees above the floor."""
    low, high = np.sin(np.deg2rad(18)), np.sin(np.deg2rad(62))
    z = low + (high - low) * (i + 0.5) / n
    azimuth = i * np.pi * (3.0 - np.sqrt(5.0))
    ring = np.sqrt(1.0 - z * z)
    return RADIUS * np.array([ring * np.cos(azimuth), ring * np.sin(azimuth), z])


def look_at(position: Array, target: Array) -> Array:
    """Return world to camera [4, 4]: x right, y down, z forward, world z up."""
    forward = (target - position) / np.linalg.norm(target - position)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ position
    return viewmat


def sample_surfaces(n: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return points [n, 3] and colours [n, 3]: half of them on the floor, the others on the objects."""
    counts = [n // 8] * (len(SPHERES) + len(BOXES))
    points, items, normals = [], [], []
    for k, (sphere, count) in enumerate(zip(SPHERES, counts, strict=False)):
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        points.append(np.array(sphere.centre) + sphere.radius * direction)
        normals.append(direction)
        items.append(np.full(count, k))
    for k, (box, count) in enumerate(zip(BOXES, counts[FIRST_BOX:], strict=False)):
        low, high = np.array(box.low), np.array(box.high)
        face = rng.integers(0, 5, count)  # four sides and the top
        axis, side = np.array([0, 0, 1, 1, 2])[face], np.array([0, 1, 0, 1, 1])[face]
        p = rng.uniform(low, high, (count, 3))
        rows = np.arange(count)
        p[rows, axis] = np.where(side, high[axis], low[axis])
        points.append(p)
        normals.append(np.eye(3)[axis] * (2 * side - 1)[:, None])
        items.append(np.full(count, FIRST_BOX + k))
    rest = n - sum(counts)
    floor = rng.uniform(-FLOOR_HALF, FLOOR_HALF, (rest, 3)) * (1, 1, 0)
    points.append(floor)
    normals.append(np.tile((0.0, 0.0, 1.0), (rest, 1)))
    items.append(np.full(rest, FLOOR))
    xyz, item, normal = np.concatenate(points), np.concatenate(items), np.concatenate(normals)
    colour, _ = lit_albedo(xyz.T, (xyz + EPS * normal).T, item, normal.T)
    return xyz, colour.T.clip(0, 1)
