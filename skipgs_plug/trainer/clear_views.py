"""Space in front of the cameras that stays clear of Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from skipgs_plug.trainer.near_plane import depths_in_picture, nearest_depths
from skipgs_plug.trainer.scene import Scene

FADED = -10.0  # logit of an opacity of 0.00005, which no rasterizer draws
MOST = 64  # views, at most, that one event looks at, which bounds the time; other events take others


class ClearViews:
    """Fades Gaussians that float between a camera and everything that it sees.

    Such a Gaussian imitates what one view shows, and hides the scene from views that were not trained on. The points of
    a scene tell how near a photograph can show anything. A view that shows too few points has no limit.

    Gaussians are faded right before an event of densification, which prunes them, or moves them (MCMC). Fading them in
    each iteration costs scenes whose foreground has no points: 0.13 dB on 24 views of a table.

    Args:
        scene: Training views and points.
        share: Least depth of a Gaussian, as a share of the depth of the nearest points in the picture; 0 fades none.
    """

    def __init__(self, scene: Scene, share: float) -> None:
        depths = nearest_depths(scene.train, scene.points) if share else []
        self._limited = [
            (view, share * depth) for view, depth in zip(scene.train, depths, strict=False) if depth is not None
        ]

    @torch.no_grad()
    def fade(self, means: Tensor, opacities: Tensor, number: int) -> None:
        """Fade Gaussians that lie in the picture of a view, and nearer to its camera than its limit.

        Args:
            means: Positions [N, 3].
            opacities: Logits [N]; changed in place.
            number: A random number, which chooses the views if there are many.
        """
        turns = -(-len(self._limited) // MOST)
        for view, limit in self._limited[number % turns :: turns] if turns else ():
            row = view.viewmat[2].to(means)
            depth = torch.addmv(row[3], means, row[:3])
            near = ((depth > 0) & (depth < limit)).nonzero()[:, 0]  # few: only these are projected
            if len(near):
                shown = depths_in_picture(view, means[near].cpu()) > 0
                opacities.index_fill_(0, near[shown.to(near.device)], FADED)
