"""The near and far clipping planes for a scene of any size."""

from __future__ import annotations

import numpy as np
import torch

from skipgs_plug.trainer.config import TINY, TrainConfig
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.scene import Scene, View

SHARE = 0.1  # near plane as a share of the nearest points' depth: a surface may come closer than its points
NEAREST = 0.01  # share of a view's points that may be nearer than its nearest depth: they are wrong matches
LEAST = 20  # points that a view needs for its depth to count: fewer may be wrong matches
MOST = 20_000  # projected points, at most, which bounds the time; of more points, every n-th is used
# Near plane as a share of the cameras' extent, if the points tell no depth. 3DGS uses 0.2 units in scenes whose cameras
# spread over about 5 units.
SHARE_OF_EXTENT = 0.04


def near_plane(config: TrainConfig, scene: Scene, depths: list[float | None] | None = None) -> float:
    """Return the near clipping plane in local units: that of the settings, or a tenth of the nearest points' depth.

    A Gaussian close to a camera covers its whole picture, and no other view shows that it is wrong. Nothing in a
    photograph is so near. A fixed distance cannot be right, since a COLMAP scene has no unit.

    Args:
        config: Settings.
        scene: The scene.
        depths: Result of `nearest_depths` for the training views; None if it is not known yet.

    Raises:
        InputError: The near plane is not below the far plane.
    """
    chosen = None if config.near_plane is None else config.near_plane / scene.frame.unit
    if chosen is None:
        depths = nearest_depths(scene.train, scene.points) if depths is None else depths
        known = [depth for depth in depths if depth is not None]
        chosen = SHARE * min(known) if known else SHARE_OF_EXTENT * scene.scene_scale
        chosen = max(chosen, TINY)
    if chosen >= far_plane(config, scene):
        raise InputError(
            f"The near plane {scene.frame.dataset_length(chosen):g} is not below far_plane={config.far_plane:g}; "
            "raise --far-plane or leave it out."
        )
    return chosen


def far_plane(config: TrainConfig, scene: Scene) -> float:
    """Return the far clipping plane in local units. The default cuts nothing, whatever the unit."""
    return config.far_plane if config.far_plane == TrainConfig.far_plane else config.far_plane / scene.frame.unit


def nearest_depths(views: list[View], points: torch.Tensor) -> list[float | None]:
    """Return the depth of the nearest points in each view; None for a view that shows too few points.

    Args:
        views: Views of the scene.
        points: Points [M, 3]. A point counts for a view if it projects into its picture, even if something hides it.
    """
    points = points[:: -(-len(points) // MOST)]
    depths: list[float | None] = []
    for view in views:
        inside = depths_in_picture(view, points)
        inside = inside[inside > 0]
        depths.append(float(np.quantile(inside.numpy(), NEAREST)) if len(inside) >= LEAST else None)
    return depths


def before_a_lens(views: list[View], points: torch.Tensor, near: float) -> torch.Tensor:
    """Return which points [M] no view shows because they are nearer than `near` in every picture that they are in.

    Such points are wrong matches. As Gaussians they would never be drawn in training, so nothing would move or prune
    them. A viewer with a nearer plane would show them as fog in front of that camera.
    """
    hidden = torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        depth = points.double() @ view.viewmat[2, :3].double() + view.viewmat[2, 3].double()
        close = ((depth > 0) & (depth < near)).nonzero()[:, 0]  # few: only these are projected
        hidden[close] |= depths_in_picture(view, points[close]) > 0
    candidates = hidden.nonzero()[:, 0]
    for view in views:
        hidden[candidates] &= depths_in_picture(view, points[candidates]) < near
    return hidden


def shows_a_point(views: list[View], points: torch.Tensor, near: float, far: float) -> bool:
    """Whether a point [M] projects into the picture of a view, at a depth between `near` and `far`."""
    depths = (depths_in_picture(view, points) for view in views)
    return any(bool(((depth > near) & (depth < far)).any()) for depth in depths)


def depths_in_picture(view: View, points: torch.Tensor) -> torch.Tensor:
    """Return the depth of each point [M] whose place in the picture lies within its borders; -1 for the others."""
    camera = points.double() @ view.viewmat[:3, :3].double().T + view.viewmat[:3, 3].double()  # [M, 3]
    pixels = camera @ view.K.double().T
    x, y, depth = pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2], camera[:, 2]
    within = (depth > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    return torch.where(within, depth, -1.0)
