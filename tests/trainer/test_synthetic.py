"""The ray-traced demo scene: deterministic, and its points lie where its images show them."""

from __future__ import annotations

import torch

from skipgs_plug.trainer import Scene
from skipgs_plug.trainer.synthetic import make_scene


def test_same_arguments_same_scene(tiny_scene: Scene) -> None:
    again = make_scene(n_views=10, width=32, height=24, n_points=160)
    assert torch.equal(again.points, tiny_scene.points)
    for one, other in zip(again.train + again.test, tiny_scene.train + tiny_scene.test, strict=True):
        assert one.name == other.name and torch.equal(one.image, other.image)


def test_points_have_the_colour_of_their_pixel() -> None:
    scene = make_scene(n_views=8, width=96, height=72, n_points=1200, test_every=0)
    view = scene.train[-1]  # the steepest view hides the fewest points
    camera = scene.points.double() @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
    pixel = camera @ view.K.T
    x, y = (pixel[:, i] / pixel[:, 2] for i in (0, 1))
    inside = (pixel[:, 2] > 0) & (x >= 0) & (x < 96) & (y >= 0) & (y < 72)
    seen = view.image[y[inside].long(), x[inside].long()].float()
    error = (seen - scene.points_rgb[inside].float()).abs().mean(dim=1)
    assert inside.float().mean() > 0.6
    assert error.median() < 20
    assert (seen - seen.mean(dim=0)).abs().mean() > 40  # a flat picture would not meet the bound above
