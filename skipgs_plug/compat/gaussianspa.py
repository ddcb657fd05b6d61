"""Stand-in for `diff_gaussian_rasterization_ms` of Mini-Splatting, which GaussianSpa uses too."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.oracle.torch_reference_projection import rotation_matrices

from .compose import Splats, render, splats
from .inria import GaussianRasterizationSettings, RasterizerModule
from .pairs import pairs_by_strip, strongest
from .statistics import gather

__all__ = ["GaussianRasterizationSettings", "GaussianRasterizer"]


class GaussianRasterizer(RasterizerModule):
    """Returns (color, radii, accum_weights [N], accum_weights_count [N], accum_max_count [N]).

    accum_max_count is the number of pixels in which the Gaussian has the largest blend weight.
    """

    def forward(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> tuple:
        result = render(self.raster_settings, splats(means3D, means2D, opacities, **gaussians))
        found = gather(result.footprint)
        leading = found.strongest[found.strongest >= 0]
        largest = torch.bincount(leading, minlength=len(means3D)).to(torch.float32)
        return result.color, result.radii, found.weight, found.pixels, largest

    @torch.no_grad()
    def render_depth(self, means3D: Tensor, means2D: Tensor, opacities: Tensor, **gaussians: Any) -> dict[str, Tensor]:
        """Intersect the view ray of each pixel with the Gaussian of the largest blend weight. Not differentiable.

        Returns:
            A dictionary: render [3, H, W]; out_pts [3, H, W], world points in the middle of the ray's path through the
            3-sigma ellipsoid; rendered_depth [1, H, W]; discriminants [1, H, W] of the intersection, negative if the
            ray misses; gidx [1, H, W] int32, rows of the Gaussians; accum_alpha [1, H, W], remaining transmittance.
        """
        settings = self.raster_settings
        scene = splats(means3D, means2D, opacities, **gaussians)
        result = render(settings, scene)
        f = result.footprint
        n_pixels = f.width * f.height
        points, depth, discriminants = torch.zeros(n_pixels, 3), torch.zeros(n_pixels), torch.zeros(n_pixels)
        index, absorbed = torch.zeros(n_pixels, dtype=torch.int32), torch.zeros(n_pixels)
        for pairs in pairs_by_strip(f):
            hit, along, discriminant = _ray_hits(settings, scene, pairs.gaussian, pairs.pixel)
            front = along >= 0  # ignore intersections behind the camera
            absorbed.index_add_(0, pairs.pixel[front], torch.log1p(-pairs.alpha[front]))
            rows = strongest(pairs, front)
            pixel = pairs.pixel[rows]
            points[pixel], depth[pixel] = hit[rows], along[rows]
            discriminants[pixel], index[pixel] = discriminant[rows], pairs.gaussian[rows].int()
        size = (1, f.height, f.width)
        return {
            "render": result.color,
            "out_pts": points.T.reshape(3, f.height, f.width),
            "rendered_depth": depth.reshape(size),
            "discriminants": discriminants.reshape(size),
            "gidx": index.reshape(size),
            "accum_alpha": absorbed.exp().reshape(size),
        }


def _ray_hits(settings: Any, scene: Splats, gaussian: Tensor, pixel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the middle of each ray's path through a 3-sigma ellipsoid: point [P, 3], depth [P], discriminant [P]."""
    width, height = int(settings.image_width), int(settings.image_height)
    view = settings.viewmatrix
    x = (2 * (pixel % width + 0.5) / width - 1) * settings.tanfovx
    y = (2 * (pixel // width + 0.5) / height - 1) * settings.tanfovy
    ray = torch.stack([x, y, torch.ones_like(x)], dim=-1) @ view[:3, :3].T  # camera depth 1
    length = ray.norm(dim=1)
    direction = ray / length[:, None]
    axes = rotation_matrices(scene.rotations)[gaussian]  # columns are the ellipsoid's axes
    size = 3 * scene.scales[gaussian]
    origin = torch.einsum("pij,pi->pj", axes, settings.campos - scene.means3D[gaussian]) / size
    heading = torch.einsum("pij,pi->pj", axes, direction) / size
    a, b = heading.square().sum(1), 2 * (heading * origin).sum(1)
    discriminant = b * b - 4 * a * (origin.square().sum(1) - 1)
    along = -b / (2 * a)
    return settings.campos + along[:, None] * direction, along / length, discriminant
