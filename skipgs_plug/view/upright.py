"""The up direction of a scene, estimated from how its photographs were held."""

from __future__ import annotations

import numpy as np

# Weight of the cameras' mean up direction against the assumption that they were held level. It is small, so that it
# decides only where the assumption leaves the direction open.
TRUST = 0.02


def up_direction(poses: np.ndarray) -> np.ndarray:
    """Return the unit vector [3] that points up in a scene.

    Cameras are tilted down or up but mostly held level, so the up direction is perpendicular to their right axes. The
    mean of the cameras' own up directions is a weaker hint: on half a circle around a subject it leans to one side. It
    is needed where all cameras look the same way, since the right axes then leave a plane open. Both hints form one
    least-squares problem.

    Args:
        poses: Camera to world, OpenCV axes (x right, y down), [V, 4, 4].
    """
    right, own = poses[:, :3, 0], -poses[:, :3, 1].mean(axis=0)
    up = np.linalg.solve(right.T @ right / len(poses) + TRUST * np.eye(3), own)
    return up / max(float(np.linalg.norm(up)), 1e-9)
