"""Stand-in for `diff_gaussian_rasterization` of Inria's 3D Gaussian Splatting, classic and current.

The two versions differ by one setting. The current one (branch `dr_aa`) passes `antialiasing` and receives the inverse
depth as a third result.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .compose import NEAR_PLANE, render, splats
from .settings import settings_class

# The classic version has no `antialiasing`: there it is None. The first one, which GaussianShader uses, has no `debug`.
GaussianRasterizationSettings = settings_class({"debug": ("antialiasing",)}, defaults=(False, None))


class MissingOutputError(IndexError):
    """A script reads an output that the stand-in's rasterizer does not have."""


class Outputs(tuple[Any, ...]):
    """Outputs of a rasterizer. The rasterizer of a fork can have more."""

    def __getitem__(self, index: Any) -> Any:
        try:
            return super().__getitem__(index)
        except IndexError:
            raise MissingOutputError(f"no output {index}: the rasterizer has {len(self)} outputs") from None


class RasterizerModule(torch.nn.Module):
    """Base of the rasterizer class of every family."""

    def __init__(self, raster_settings: Any) -> None:
        super().__init__()
        self.raster_settings = raster_settings

    def __call__(self, *args: Any, **kwargs: Any) -> Outputs:
        return Outputs(super().__call__(*args, **kwargs))

    @torch.no_grad()
    def markVisible(self, positions: Tensor) -> Tensor:
        """Mask points [N, 3] that lie beyond the near plane. [N] bool"""
        view = self.raster_settings.viewmatrix
        return positions @ view[:3, 2] + view[3, 2] > NEAR_PLANE


class GaussianRasterizer(RasterizerModule):
    """Returns (color [3, H, W], radii [N]), and inverse depth [1, H, W] if `antialiasing` is not None."""

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        settings = self.raster_settings
        scene = splats(means3D, means2D, opacities, **gaussians)
        if settings.antialiasing is None:
            return render(settings, scene)[:2]
        result = render(settings, scene, antialiased=settings.antialiasing, inverse_depth=True)
        return result.color, result.radii, result.inverse_depth
