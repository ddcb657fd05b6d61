"""The per-Gaussian half of the reference rasterizer in plain PyTorch: projection, colours and tiles."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

# A contribution with a smaller alpha is dropped, as in gsplat and Inria's rasterizer: it is less than a step of 8 bits.
ALPHA_THRESHOLD = 1.0 / 255.0
# Half extent of a Gaussian in standard deviations, at most: sqrt(2 ln 255) = 3.329, where a Gaussian of opacity 1 falls
# to ALPHA_THRESHOLD. gsplat rounds it up to 3.33.
RADIUS_SIGMAS = 3.33


class Projected(NamedTuple):
    """Gaussians on the image plane, one row for each visible (camera, Gaussian) pair."""

    means2d: Tensor  # [M, 2] pixels
    depths: Tensor  # [M]
    conics: Tensor  # [M, 3] inverse 2D covariance: xx, xy, yy
    opacities: Tensor  # [M] compensated in antialiased mode
    radii: Tensor  # [M, 2] int32 half extents in pixels; 0 where culled


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotation matrices [M, 3, 3] of quaternions w, x, y, z [M, 4] of any length. Zero gives the identity."""
    w, x, y, z = F.normalize(quats, dim=-1, eps=torch.finfo(quats.dtype).tiny).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def project(
    means: Tensor,  # [M, 3]
    quats: Tensor,  # [M, 4]
    scales: Tensor,  # [M, 3]
    opacities: Tensor,  # [M]
    viewmats: Tensor,  # [M, 4, 4]
    Ks: Tensor,  # [M, 3, 3]
    width: int,
    height: int,
    eps2d: float,
    antialiased: bool,
    near_plane: float,
    far_plane: float,
    radius_clip: float,
) -> Projected:
    """Project Gaussians onto image planes (EWA splatting, Zwicker et al. 2001), each with the camera of its row."""
    rotation = viewmats[:, :3, :3]
    x, y, z = (torch.einsum("mij,mj->mi", rotation, means) + viewmats[:, :3, 3]).unbind(-1)
    axes = rotation @ (rotation_matrices(quats) * scales[:, None, :])  # [M, 3, 3]

    # The Jacobian is evaluated at most 15 % of the image's size beyond its border.
    fx, fy, cx, cy = Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    tan_x = torch.clamp(x / z, min=-(cx / fx + margin_x), max=(width - cx) / fx + margin_x)
    tan_y = torch.clamp(y / z, min=-(cy / fy + margin_y), max=(height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z], dim=-1)
    flat = jacobian.reshape(-1, 2, 3) @ axes
    covariance = flat @ flat.transpose(-1, -2)  # [M, 2, 2]

    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    # det(A A^T) as the squared area that A's rows span: no cancellation for thin needles.
    sharp_determinant = torch.linalg.cross(flat[:, 0], flat[:, 1]).square().sum(dim=-1)
    determinant = sharp_determinant + eps2d * (xx + yy) + eps2d**2
    xx, yy = xx + eps2d, yy + eps2d
    if antialiased:
        opacities = opacities * (sharp_determinant / determinant).clamp_min(0.0).sqrt()

    reach = (2 * (opacities / ALPHA_THRESHOLD).clamp_min(1.0).log()).sqrt().clamp_max(RADIUS_SIGMAS)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    extent = (reach[:, None] * torch.stack([xx, yy], dim=-1).sqrt()).ceil()
    image_size = means.new_tensor([width, height])
    kept = (z >= near_plane) & (z <= far_plane) & (determinant > 0) & (opacities >= ALPHA_THRESHOLD)
    kept &= (extent > radius_clip).any(dim=-1)
    kept &= ((means2d + extent > 0) & (means2d - extent < image_size)).all(dim=-1)
    extent = torch.where(kept[:, None], extent, 0.0).clamp_max(2.0**31 - 256)
    conics = torch.stack([yy, -xy, xx], dim=-1) / determinant[:, None]
    return Projected(means2d, z, conics, opacities, extent.detach().to(torch.int32))


def spherical_harmonics(degree: int, directions: Tensor, coeffs: Tensor) -> Tensor:
    """Evaluate real spherical harmonics (Sloan, JCGT 2013).

    Args:
        degree: Highest degree that is evaluated, 0 to 3.
        directions: Directions of any length. [M, 3]
        coeffs: Coefficients of D channels, K >= (degree + 1)^2. [M, K, D]

    Returns:
        Sums over the basis functions. [M, D]
    """
    x, y, z = F.normalize(directions, dim=-1).unbind(-1)
    basis = [torch.full_like(x, 0.2820947917738781)]
    if degree >= 1:
        basis += [-0.48860251190292 * y, 0.48860251190292 * z, -0.48860251190292 * x]
    if degree >= 2:
        basis += [
            1.092548430592079 * x * y,
            -1.092548430592079 * y * z,
            0.9461746957575601 * z * z - 0.3153915652525201,
            -1.092548430592079 * x * z,
            0.5462742152960395 * (x * x - y * y),
        ]
    if degree >= 3:
        basis += [
            -0.5900435899266435 * y * (3 * x * x - y * y),
            2.890611442640554 * x * y * z,
            y * (0.4570457994644658 - 2.285228997322329 * z * z),
            z * (1.865881662950577 * z * z - 1.119528997770346),
            x * (0.4570457994644658 - 2.285228997322329 * z * z),
            1.445305721320277 * z * (x * x - y * y),
            -0.5900435899266435 * x * (x * x - 3 * y * y),
        ]
    return torch.einsum("mk,mkd->md", torch.stack(basis, dim=-1), coeffs[:, : len(basis)])


@torch.no_grad()
def tiles(
    rows: Projected, image_ids: Tensor, n_images: int, width: int, height: int, tile_size: int
) -> dict[str, int | Tensor]:
    """List the tiles that each Gaussian's box touches, sorted by image, tile and depth, in gsplat's encoding."""
    tile_width, tile_height = math.ceil(width / tile_size), math.ceil(height / tile_size)
    grid = torch.tensor([tile_width, tile_height])
    means2d, radii = rows.means2d.reshape(-1, 2), rows.radii.reshape(-1, 2)
    first = ((means2d - radii) / tile_size).floor().clamp(min=0).minimum(grid).long()
    last = ((means2d + radii) / tile_size).ceil().clamp(min=0).minimum(grid).long()
    count = torch.where((radii > 0).all(dim=-1), (last - first).prod(dim=-1), 0)
    flatten_ids = torch.arange(len(count)).repeat_interleave(count)
    step = torch.arange(len(flatten_ids)) - (count.cumsum(0) - count)[flatten_ids]
    columns = (last - first)[flatten_ids, 0].clamp(min=1)
    tile_ids = (first[flatten_ids, 1] + step // columns) * tile_width + first[flatten_ids, 0] + step % columns
    tile_bits = (tile_width * tile_height).bit_length()
    depth_bits = rows.depths.reshape(-1).float().view(torch.int32).long()[flatten_ids] & 0xFFFFFFFF
    tile_keys = (image_ids[flatten_ids] << tile_bits) | tile_ids
    isect_ids, order = torch.sort((tile_keys << 32) | depth_bits, stable=True)
    n_tiles = tile_width * tile_height
    per_tile = torch.bincount(image_ids[flatten_ids] * n_tiles + tile_ids, minlength=n_images * n_tiles)
    return {
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": count.to(torch.int32).reshape(rows.depths.shape),
        "isect_ids": isect_ids,
        "flatten_ids": flatten_ids[order].to(torch.int32),
        "isect_offsets": (per_tile.cumsum(0) - per_tile).reshape(n_images, tile_height, tile_width).to(torch.int32),
    }
