"""Space around the cameras that stays clear of Gaussians."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from skipgs_plug.trainer.near_plane import depths_in_picture
from skipgs_plug.trainer.scene import View

FADED = -10.0  # logit of an opacity of 0.00005, which no rasterizer draws
# Largest number of training views with a limit. More views correct each other: a plant with 157 views loses 0.09 dB.
FEW = 100
# Distance from a camera, as a part of its limit, within which there is nothing in any direction: a photographer stood
# there. With the whole limit, a room loses 0.14 dB, since furniture beside the cameras is nearer.
AROUND = 0.5


class ClearViews:
    """Fades Gaussians that float between a camera and everything that it sees, or around it.

    Such a Gaussian imitates what one view shows, and hides the scene from views that were not trained on. The points of
    a scene tell how near a photograph can show anything. A view that shows too few points has no limit. Neither has a
    view among many.

    Gaussians are faded right before an event of densification, which prunes them, or moves them (MCMC). Fading them in
    each iteration costs scenes whose foreground has no points: 0.13 dB on 24 views of a table.

    Args:
        views: Training views.
        depths: Depth of the nearest points in each; see `nearest_depths`.
        share: Least depth of a Gaussian, as a share of the depth of the nearest points in the picture; 0 fades none.
    """

    def __init__(self, views: list[View], depths: list[float | None], share: float) -> None:
        pairs = zip(views, depths, strict=True) if share and len(views) <= FEW else ()
        self._limited = [_LimitedView.of(view, share * depth) for view, depth in pairs if depth is not None]

    @torch.no_grad()
    def fade(self, means: Tensor, opacities: Tensor) -> None:
        """Fade Gaussians that lie in the picture of a view nearer than its limit, or around its camera.

        Args:
            means: Positions [N, 3].
            opacities: Logits [N]; changed in place.
        """
        if not self._limited:
            return
        squares = (means * means).sum(dim=1)
        for view, limit, camera, reach in self._limited:
            close = (torch.addmv(squares, means, -2.0 * camera.to(means)) < reach).nonzero()[:, 0]
            if not len(close):
                continue
            points = means[close].cpu().double()
            shown = depths_in_picture(view, points)
            near = (shown > 0) & (shown < limit)
            near |= (points - camera).norm(dim=1) < AROUND * limit
            opacities.index_fill_(0, close[near.to(close.device)], FADED)


class _LimitedView(NamedTuple):
    """A view, and the constants that tell which Gaussians are near its camera.

    Attributes:
        view: The view.
        limit: Least depth of a Gaussian in its picture.
        camera: Position [3] of the camera.
        reach: For positions x that can be in the picture nearer than the limit, x @ x - 2 * x @ camera is less.
    """

    view: View
    limit: float
    camera: Tensor
    reach: float

    @classmethod
    def of(cls, view: View, limit: float) -> _LimitedView:
        """Return a view with a limit."""
        camera = -view.viewmat[:3, :3].T @ view.viewmat[:3, 3]
        w, h = float(view.width), float(view.height)
        corners = torch.tensor([[0.0, w, 0.0, w], [0.0, 0.0, h, h], [1.0] * 4], dtype=torch.float64)
        farthest = float(torch.linalg.solve(view.K.double(), corners).norm(dim=0).max())  # corner, at a depth of 1
        return cls(view, limit, camera, (limit * farthest) ** 2 - float(camera @ camera))
