"""Where rendering begins in front of a camera, for a scene of any size."""

from __future__ import annotations

import numpy as np
import torch

from skipgs_plug.trainer.config import TINY, TrainConfig
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.scene import Scene, View

SHARE = 0.1  # near plane as a share of the depth of the nearest points: surfaces may be nearer than any point on them
NEAREST = 0.01  # share of a view's points that may be nearer than its depth: these are wrong matches
LEAST = 20  # points in a view, at least, for its depth to count
MOST = 20_000  # points that are projected, at most, which bounds the time; of more, every n-th
# Near plane as a share of the cameras' extent, for a scene whose points tell no depth: 3DGS uses 0.2 units in scenes
# whose cameras spread over about 5.
SHARE_OF_EXTENT = 0.04


def near_plane(config: TrainConfig, scene: Scene) -> float:
    """Return the near clipping plane in local units: that of the settings, or a tenth of the nearest points' depth.

    A Gaussian close to a camera covers its whole picture, and no other view tells that it is wrong. Nothing that was
    photographed lies so near. A fixed distance cannot be right: a COLMAP scene has no unit.

    Raises:
        InputError: not below the far plane.
    """
    chosen = None if config.near_plane is None else config.near_plane / scene.frame.unit
    if chosen is None:
        nearest = nearest_depth(scene.train, scene.points)
        chosen = SHARE_OF_EXTENT * scene.scene_scale if nearest is None else SHARE * nearest
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


def nearest_depth(views: list[View], points: torch.Tensor) -> float | None:
    """Return the least depth of a view's nearest points, over all views; None if no view shows enough points.

    Args:
        points: [M, 3], those that lie within a view's picture count for it, whether or not something hides them.
    """
    points = points[:: -(-len(points) // MOST)]
    depths = []
    for view in views:
        inside = depths_in_picture(view, points)
        inside = inside[inside > 0]
        if len(inside) >= LEAST:
            depths.append(float(np.quantile(inside.numpy(), NEAREST)))
    return min(depths, default=None)


def before_a_lens(views: list[View], points: torch.Tensor, near: float) -> torch.Tensor:
    """Return which points [M] some view would show if they were not nearer than `near`, and no view shows.

    Wrong matches. As Gaussians they would never be drawn in training, so nothing would move or prune them, and whoever
    looks from near that camera with a nearer plane would see fog.
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


def depths_in_picture(view: View, points: torch.Tensor) -> torch.Tensor:
    """Return the depth of each point [M] whose place in the picture lies within its borders; -1 for the others."""
    camera = points.double() @ view.viewmat[:3, :3].double().T + view.viewmat[:3, 3].double()  # [M, 3]
    pixels = camera @ view.K.double().T
    x, y, depth = pixels[:, 0] / pixels[:, 2], pixels[:, 1] / pixels[:, 2], camera[:, 2]
    within = (depth > 0) & (x >= 0) & (x < view.width) & (y >= 0) & (y < view.height)
    return torch.where(within, depth, -1.0)
