"""Which way is up."""

import numpy as np
import pytest

from skipgs_plug.view.upright import up_direction


def looking_at_the_middle(angles, height):
    """Cameras on a circle of radius 1 around the z axis, `height` above the point at which they look."""
    poses = np.tile(np.eye(4), (len(angles), 1, 1))
    for pose, angle in zip(poses, angles, strict=True):
        position = np.array([np.cos(angle), np.sin(angle), height])
        ahead = -position / np.linalg.norm(position)
        right = np.cross(ahead, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
        pose[:3, 3] = position
    return poses


def degrees_from_z(poses):
    return float(np.degrees(np.arccos(np.clip(up_direction(poses)[2], -1.0, 1.0))))


@pytest.mark.parametrize("turn", [2 * np.pi, np.pi, np.pi / 2])
def test_an_arc_of_cameras_that_look_down_stands_upright(turn):
    poses = looking_at_the_middle(np.linspace(0.0, turn, 24, endpoint=False), height=1.0)
    own = -poses[:, :3, 1].mean(axis=0)
    assert degrees_from_z(poses) < 10.0
    if turn <= np.pi:
        leaning = np.degrees(np.arccos(own[2] / np.linalg.norm(own)))
        assert leaning > 25.0  # the mean of the up directions alone would lean


def test_cameras_that_look_the_same_way_keep_their_own_up():
    poses = looking_at_the_middle(np.linspace(-0.05, 0.05, 9), height=0.5)
    own = -poses[:, :3, 1].mean(axis=0)
    assert up_direction(poses) @ (own / np.linalg.norm(own)) > 0.99


def test_a_single_camera_is_enough():
    assert up_direction(np.eye(4)[None]) == pytest.approx([0.0, -1.0, 0.0])
