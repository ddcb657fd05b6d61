"""A small ray tracer in numpy: spheres, boxes and a floor, one light, hard shadows, one mirror bounce.

The z axis points up, and the floor is the plane z = 0. An array holds one value per ray or point, [R], or one row per
coordinate, [3, R], because numpy is faster on long rows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from skipgs_plug.trainer.textures import TEXTURES

Array = np.ndarray

SKY = (0.62, 0.71, 0.80)  # RGB in [0, 1] of rays that hit nothing
LIGHT = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])  # unit vector towards the light
FLOOR_HALF = 2.6  # half of the floor's side in scene units
# Scene units that a ray must travel before it can hit. It keeps a ray from hitting the surface it starts on.
EPS = 1e-4
BATCH = 4096  # number of rays that are traced at once, so that their arrays stay in the processor's caches


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
    """Return the image [H, W, 3] in [0, 1]. Each pixel is the mean of 2x2 samples."""
    x, y = np.meshgrid((np.arange(2 * width) + 0.5) / 2, (np.arange(2 * height) + 0.5) / 2)
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)]).reshape(3, -1)
    rays /= np.sqrt(dot(rays, rays))
    directions = viewmat[:3, :3].T @ rays
    origin = -viewmat[:3, :3].T @ viewmat[:3, 3]
    colour = np.empty(directions.shape)
    for begin in range(0, directions.shape[1], BATCH):
        part = directions[:, begin : begin + BATCH]
        colour[:, begin : begin + BATCH] = shade(np.broadcast_to(origin[:, None], part.shape), part, bounces=1)
    return colour.reshape(3, height, 2, width, 2).mean(axis=(2, 4)).transpose(1, 2, 0)


def dot(a: Array, b: Array) -> Array:
    """Return the dot products [R] of vectors [3, R]. Either argument may be a single vector, [3, 1]."""
    product: Array = a[0] * b[0]
    product += a[1] * b[1]
    product += a[2] * b[2]
    return product


def column(vector: tuple[float, ...] | Array) -> Array:
    """Return a vector or colour as an array [3, 1], which broadcasts with [3, R]."""
    return np.asarray(vector, dtype=float)[:, None]


def shade(origins: Array, directions: Array, bounces: int) -> Array:
    """Return the colour [3, R] that arrives along each ray."""
    distance, item, normal = intersect(origins, directions)
    colour = np.repeat(column(SKY), directions.shape[1], axis=1)
    hit = item >= 0
    if not hit.any():
        return colour
    normal, item, incoming = normal[:, hit], item[hit], directions[:, hit]
    points = origins[:, hit] + distance[hit] * incoming
    lifted = points + EPS * normal
    surface, lit = lit_albedo(points, lifted, item, normal)
    for k, sphere in enumerate(SPHERES):
        on = item == k
        if not sphere.mirror or not on.any():
            continue
        reflected = incoming[:, on] - 2 * dot(incoming[:, on], normal[:, on]) * normal[:, on]
        glint = dot(column(LIGHT), reflected).clip(0) ** 60 * (lit[on] > 0)
        if bounces:
            mirrored = shade(lifted[:, on], reflected, bounces - 1)
            surface[:, on] = (1 - sphere.mirror) * surface[:, on] + sphere.mirror * mirrored
        surface[:, on] += glint
    colour[:, hit] = surface.clip(0, 1)
    return colour


def lit_albedo(points: Array, lifted: Array, item: Array, normal: Array) -> tuple[Array, Array]:
    """Return the matte colour [3, R] with light and shadow, and the share of the light [R] that arrives."""
    lit = dot(column(LIGHT), normal).clip(0) * ~occluded(lifted)
    return albedo(points, item) * (0.35 + 0.65 * lit), lit


def intersect(origins: Array, directions: Array) -> tuple[Array, Array, Array]:
    """Return distance [R], item [R] and normal [3, R] of the nearest surface. The item is -1 where a ray hits nothing.

    Items are numbered: first the spheres, then the boxes, then the floor.
    """
    rays = directions.shape[1]
    nearest, item, normal = np.full(rays, np.inf), np.full(rays, -1), np.zeros((3, rays))
    for k, sphere in enumerate(SPHERES):
        t = sphere_distance(origins, directions, sphere)
        closer = np.flatnonzero(t < nearest)
        nearest[closer], item[closer] = t[closer], k
        points = origins[:, closer] + t[closer] * directions[:, closer]
        normal[:, closer] = (points - column(sphere.centre)) / sphere.radius
    for k, box in enumerate(BOXES):
        t, near = box_distance(origins, directions, box)
        closer = np.flatnonzero(t < nearest)
        nearest[closer], item[closer] = t[closer], FIRST_BOX + k
        axis = near[:, closer].argmax(axis=0)  # axis of the normal of the face that was hit
        normal[:, closer] = 0.0
        normal[axis, closer] = -np.sign(directions[axis, closer])
    t = floor_distance(origins, directions)
    closer = np.flatnonzero(t < nearest)
    nearest[closer], item[closer], normal[:, closer] = t[closer], FLOOR, column((0.0, 0.0, 1.0))
    return nearest, item, normal


def occluded(origins: Array) -> Array:
    """Return whether a sphere or a box stands between each point [3, R] and the light, as booleans [R]."""
    directions = column(LIGHT)
    blocked = np.zeros(origins.shape[1], dtype=bool)
    for sphere in SPHERES:
        blocked |= np.isfinite(sphere_distance(origins, directions, sphere))
    for box in BOXES:
        blocked |= np.isfinite(box_distance(origins, directions, box)[0])
    return blocked


def sphere_distance(origins: Array, directions: Array, sphere: Sphere) -> Array:
    """Return the distance [R] to a sphere along rays [3, R], infinite where they miss it.

    `directions` may be a single direction, [3, 1].
    """
    offset = origins - column(sphere.centre)
    b = dot(offset, directions)
    root = b * b - dot(offset, offset) + sphere.radius**2
    t = -b - np.sqrt(np.maximum(root, 0))
    return np.where((root > 0) & (t > EPS), t, np.inf)


def box_distance(origins: Array, directions: Array, box: Box) -> tuple[Array, Array]:
    """Return the distance [R] to a box, and the distance [3, R] at which each ray enters the slab of each axis.

    The distance to the box is infinite where a ray misses it. `directions` may be a single direction, [3, 1].
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        near = (column(box.low) - origins) / directions
        far = (column(box.high) - origins) / directions
    near, far = np.minimum(near, far), np.maximum(near, far)
    enter = np.maximum(np.maximum(near[0], near[1]), near[2])
    leave = np.minimum(np.minimum(far[0], far[1]), far[2])
    return np.where((enter < leave) & (enter > EPS), enter, np.inf), near


def floor_distance(origins: Array, directions: Array) -> Array:
    """Return the distance [R] to the floor along rays [3, R], infinite where they miss it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origins[2] / directions[2]
        x, y = (origins[i] + t * directions[i] for i in (0, 1))
    on = (t > EPS) & (np.abs(x) < FLOOR_HALF) & (np.abs(y) < FLOOR_HALF)
    return np.where(on, t, np.inf)


def albedo(points: Array, item: Array) -> Array:
    """Return the colour [3, R] without light of surface points [3, R], each on its item [R]."""
    colour = np.empty(points.shape)
    textures = [sphere.texture for sphere in SPHERES] + [box.texture for box in BOXES] + ["tiles"]
    for k, texture in enumerate(textures):
        on = np.flatnonzero(item == k)
        if len(on):
            colour[:, on] = TEXTURES[texture](points[:, on])
    return colour
