"""A small ray tracer in numpy: spheres, boxes and a floor, one light, hard shadows, one mirror bounce.

Arrays hold one row per ray or point: [R], [R, 3].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skipgs_plug.trainer.textures import TEXTURES

Array = np.ndarray

SKY = (0.62, 0.71, 0.80)
LIGHT = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
FLOOR_HALF = 2.6
EPS = 1e-4


@dataclass(frozen=True)
class Sphere:
    centre: tuple[float, float, float]
    radius: float
    mirror: float
    texture: str


@dataclass(frozen=True)
class Box:
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    texture: str


SPHERES = (
    Sphere((0.55, 0.35, 0.5), 0.5, 0.65, "gold"),
    Sphere((-0.35, -0.85, 0.32), 0.32, 0.0, "stripes"),
)
BOXES = (
    Box((-1.15, 0.05, 0.0), (-0.45, 0.75, 0.9), "bricks"),
    Box((0.55, -1.15, 0.0), (1.25, -0.65, 0.45), "noise"),
)
FLOOR, FIRST_BOX = len(SPHERES) + len(BOXES), len(SPHERES)


def trace_view(viewmat: Array, K: Array, width: int, height: int) -> Array:
    """Return the image [H, W, 3] in [0, 1], mean of 2x2 samples per pixel."""
    x, y = np.meshgrid((np.arange(2 * width) + 0.5) / 2, (np.arange(2 * height) + 0.5) / 2)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    directions = rays @ viewmat[:3, :3]
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colour = shade(np.broadcast_to(origin, directions.shape), directions, bounces=1)
    return colour.reshape(height, 2, width, 2, 3).mean(axis=(1, 3))


def shade(origins: Array, directions: Array, bounces: int) -> Array:
    """Return the colour [R, 3] that arrives along each ray."""
    distance, item, normal = intersect(origins, directions)
    colour = np.tile(SKY, (len(directions), 1))
    hit = item >= 0
    if not hit.any():
        return colour
    points = origins[hit] + distance[hit, None] * directions[hit]
    normal, item, incoming = normal[hit], item[hit], directions[hit]
    lifted = points + EPS * normal
    surface, lit = lit_albedo(points, lifted, item, normal)
    reflected = incoming - 2 * (incoming * normal).sum(axis=1, keepdims=True) * normal
    for k, sphere in enumerate(SPHERES):
        on = item == k
        if not sphere.mirror or not on.any():
            continue
        glint = (reflected[on] @ LIGHT).clip(0) ** 60 * (lit[on] > 0)
        if bounces:
            mirrored = shade(lifted[on], reflected[on], bounces - 1)
            surface[on] = (1 - sphere.mirror) * surface[on] + sphere.mirror * mirrored
        surface[on] += glint[:, None]
    colour[hit] = surface.clip(0, 1)
    return colour


def lit_albedo(points: Array, lifted: Array, item: Array, normal: Array) -> tuple[Array, Array]:
    """Return the matte colour [R, 3] under light and shadow, and the light's share [R]."""
    lit = (normal @ LIGHT).clip(0) * ~occluded(lifted)
    return albedo(points, item) * (0.35 + 0.65 * lit)[:, None], lit


def intersect(origins: Array, directions: Array) -> tuple[Array, Array, Array]:
    """Return distance [R], item [R] (-1 for none) and normal [R, 3] of the nearest surface."""
    rays = len(directions)
    nearest, item, normal = np.full(rays, np.inf), np.full(rays, -1), np.zeros((rays, 3))
    for k, sphere in enumerate(SPHERES):
        t = sphere_distance(origins, directions, sphere)
        closer = t < nearest
        nearest[closer], item[closer] = t[closer], k
        points = origins[closer] + t[closer, None] * directions[closer]
        normal[closer] = (points - sphere.centre) / sphere.radius
    for k, box in enumerate(BOXES):
        t, axis = box_distance(origins, directions, box)
        closer = t < nearest
        nearest[closer], item[closer] = t[closer], FIRST_BOX + k
        face = np.eye(3)[axis[closer]]
        normal[closer] = -np.sign((directions[closer] * face).sum(axis=1, keepdims=True)) * face
    t = floor_distance(origins, directions)
    closer = t < nearest
    nearest[closer], item[closer], normal[closer] = t[closer], FLOOR, (0.0, 0.0, 1.0)
    return nearest, item, normal


def occluded(origins: Array) -> Array:
    """Return whether something stands between each point [R, 3] and the light."""
    directions = np.broadcast_to(LIGHT, origins.shape)
    blocked = np.zeros(len(origins), dtype=bool)
    for sphere in SPHERES:
        blocked |= np.isfinite(sphere_distance(origins, directions, sphere))
    for box in BOXES:
        blocked |= np.isfinite(box_distance(origins, directions, box)[0])
    return blocked


def sphere_distance(origins: Array, directions: Array, sphere: Sphere) -> Array:
    offset = origins - np.array(sphere.centre)
    b = (offset * directions).sum(axis=1)
    root = b * b - (offset * offset).sum(axis=1) + sphere.radius**2
    t = -b - np.sqrt(np.maximum(root, 0))
    return np.where((root > 0) & (t > EPS), t, np.inf)


def box_distance(origins: Array, directions: Array, box: Box) -> tuple[Array, Array]:
    """Return distance [R] and the axis [R] of the face that was hit (slab method)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (np.array(box.low) - origins) / directions
        far = (np.array(box.high) - origins) / directions
    near, far = np.minimum(near, far), np.maximum(near, far)
    enter, leave = near.max(axis=1), far.min(axis=1)
    return np.where((enter < leave) & (enter > EPS), enter, np.inf), near.argmax(axis=1)


def floor_distance(origins: Array, directions: Array) -> Array:
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origins[:, 2] / directions[:, 2]
        x, y = (origins[:, i] + t * directions[:, i] for i in (0, 1))
    on = (t > EPS) & (np.abs(x) < FLOOR_HALF) & (np.abs(y) < FLOOR_HALF)
    return np.where(on, t, np.inf)


def albedo(points: Array, item: Array) -> Array:
    """Return the unlit colour [R, 3] of surface points by their item."""
    colour = np.empty((len(points), 3))
    textures = [sphere.texture for sphere in SPHERES] + [box.texture for box in BOXES] + ["tiles"]
    for k, texture in enumerate(textures):
        on = item == k
        if on.any():
            colour[on] = TEXTURES[texture](points[on])
    return colour
