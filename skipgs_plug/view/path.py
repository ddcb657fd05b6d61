"""A smooth camera path through the training cameras."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from skipgs_plug.trainer.scene import View

MOST_KEYS = 30  # cameras on the path, at most; with more, it trembles like the hand of the photographer
TURN_WEIGHT = 0.5  # radii of the path per radian: a turn by one radian takes as long as a move by half a radius


def camera_path(views: list[View], frames: int) -> Tensor:
    """Return world-to-camera poses [frames, 4, 4] float64 from the first to the last view, at an even pace.

    Orientations are interpolated by Slerp, positions by monotone cubics, which do not overshoot.

    Args:
        views: Cameras in the order of the path, at least one.
        frames: Number of poses.
    """
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, Slerp

    picked = np.linspace(0, len(views) - 1, min(len(views), MOST_KEYS)).round().astype(int)
    poses = np.linalg.inv(torch.stack([views[i].viewmat for i in picked]).double().numpy())  # camera to world
    positions = poses[:, :3, 3]
    rotations = Rotation.from_matrix(poses[:, :3, :3])
    radius = float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max()) or 1.0
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=1) / radius
    turned = TURN_WEIGHT * (rotations[:-1].inv() * rotations[1:]).magnitude() if len(picked) > 1 else moved
    lengths = moved + turned
    kept = np.concatenate([[True], lengths > 1e-9])  # two photographs from one tripod are one key
    times = np.concatenate([[0.0], np.cumsum(lengths)])[kept]
    result = np.tile(np.eye(4), (frames, 1, 1))
    if len(times) == 1:
        result[:] = poses[0]
    else:
        at = np.linspace(0.0, times[-1], frames)
        result[:, :3, :3] = Slerp(times, rotations[np.flatnonzero(kept)])(at).as_matrix()
        result[:, :3, 3] = PchipInterpolator(times, positions[kept])(at)
    return torch.from_numpy(np.linalg.inv(result))
