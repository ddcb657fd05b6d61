"""Gaussian splatting in plain PyTorch, for every dtype: the oracle of the fast rasterizer.

It restates the mathematics of gsplat 1.5.3's CUDA kernels as directly as possible: project every
Gaussian, sort by depth, composite every Gaussian into every pixel. Nothing is tiled and autograd
writes the backward pass, so there is little to get wrong; it is slow and meant for small images.
In float64 its error is far below what a float32 rasterizer can reach.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.checkpoint import checkpoint

ALPHA_THRESHOLD = 1.0 / 255.0  # a fainter contribution is dropped
ALPHA_MAX = 0.999
TRANSMITTANCE_STOP = 1e-4  # the Gaussian that would go below ends the pixel, uncounted
RADIUS_SIGMAS = 3.33  # sqrt(2 ln 255), rounded up: where opacity 1 falls to ALPHA_THRESHOLD
PAIRS_PER_CHUNK = 2_000_000  # pixel-Gaussian pairs held in memory at once


class Projected(NamedTuple):
    """Gaussians on the image plane, one row for each Gaussian a camera sees."""

    means2d: Tensor  # [M, 2] pixels
    depths: Tensor  # [M]
    conics: Tensor  # [M, 3] inverse 2D covariance: xx, xy, yy
    opacities: Tensor  # [M] compensated in antialiased mode
    radii: Tensor  # [M, 2] int32 half extents in pixels, 0 where culled


def rasterization_reference(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [(C,) N, D] or [(C,) N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: str = "classic",
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render Gaussians into pinhole cameras; arguments and results as gsplat 1.5's `rasterization`.

    Differentiable in everything but `Ks`. `info["means2d"].absgrad` adds up over backward calls.

    Returns:
        Colors [C, H, W, X], alphas [C, H, W, 1], and gsplat's dictionary of intermediate results.

    Raises:
        ValueError: `sparse_grad` is set, or a mode is unknown.
    """
    if sparse_grad:
        raise ValueError("The reference has no sparse_grad: leave it False.")
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise ValueError(f"Unknown render_mode {render_mode!r}.")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"Unknown rasterize_mode {rasterize_mode!r}.")
    n_cameras, n_gaussians = len(viewmats), len(means)

    def project_rows(camera_ids: Tensor, gaussian_ids: Tensor) -> Projected:
        return project(
            means[gaussian_ids],
            quats[gaussian_ids],
            scales[gaussian_ids],
            opacities[gaussian_ids],
            viewmats[camera_ids],
            Ks.detach()[camera_ids],
            width,
            height,
            eps2d,
            rasterize_mode == "antialiased",
            near_plane,
            far_plane,
            radius_clip,
        )

    # The culled leave before anything is differentiated: their depth may be 0, their gradient is 0.
    every_row = torch.cartesian_prod(torch.arange(n_cameras), torch.arange(n_gaussians)).to(means.device)
    with torch.no_grad():
        seen = (project_rows(*every_row.T).radii > 0).all(dim=-1)
    camera_ids, gaussian_ids = every_row[seen].T
    rows = project_rows(camera_ids, gaussian_ids)

    if sh_degree is None:
        features = colors[gaussian_ids] if colors.dim() == 2 else colors[camera_ids, gaussian_ids]
    else:
        coeffs = colors[gaussian_ids] if colors.dim() == 3 else colors[camera_ids, gaussian_ids]
        directions = means[gaussian_ids] - torch.inverse(viewmats)[camera_ids, :3, 3]
        features = (spherical_harmonics(sh_degree, directions, coeffs) + 0.5).clamp_min(0.0)

    if not packed:  # [M, ...] -> [C, N, ...], zero where culled
        rows = Projected(*(_scatter(t, camera_ids, gaussian_ids, n_cameras, n_gaussians) for t in rows))
    if absgrad:
        rows.means2d.absgrad = torch.zeros_like(rows.means2d)  # type: ignore[attr-defined]

    n_depth = 0 if render_mode == "RGB" else 1
    images, alphas = [], []
    for camera in range(n_cameras):
        here = camera_ids == camera
        index = here.nonzero()[:, 0] if packed else (camera, gaussian_ids[here])
        projected = Projected(*(t[index] for t in rows))
        values = {
            "RGB": [features[here]],
            "D": [projected.depths[:, None]],
            "RGBD": [features[here], projected.depths[:, None]],
        }[render_mode.replace("+", "").replace("ED", "D")]
        background = means.new_zeros(sum(v.shape[-1] for v in values))
        if backgrounds is not None:
            colored = len(background) - n_depth  # depth is rendered onto 0
            background = torch.cat([backgrounds[camera, :colored], background[colored:]])
        absolute = _AbsoluteRows(rows.means2d, index) if absgrad else None
        image, alpha = composite(projected, torch.cat(values, -1), background, width, height, absolute)
        if render_mode.endswith("ED"):
            expected = image[..., -1:] / alpha.clamp(min=1e-10)
            image = torch.cat([image[..., :-1], expected], dim=-1)
        images.append(image)
        alphas.append(alpha)

    info: dict[str, Any] = {
        "batch_ids": torch.zeros_like(camera_ids) if packed else None,
        "camera_ids": camera_ids if packed else None,
        "gaussian_ids": gaussian_ids if packed else None,
        **rows._asdict(),
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_batches": 1,
        "n_cameras": n_cameras,
    }
    image_ids = camera_ids if packed else torch.arange(n_cameras).repeat_interleave(n_gaussians)
    info.update(tiles(rows, image_ids, n_cameras, width, height, tile_size))
    return torch.stack(images), torch.stack(alphas), info


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotations of quaternions w, x, y, z of any length. [M, 4] -> [M, 3, 3]; zero gives the identity."""
    w, x, y, z = F.normalize(quats, dim=-1).unbind(-1)
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
    """EWA projection (Zwicker et al. 2001), each Gaussian with the camera of its row."""
    rotation = viewmats[:, :3, :3]
    x, y, z = (torch.einsum("mij,mj->mi", rotation, means) + viewmats[:, :3, 3]).unbind(-1)
    axes = rotation @ (rotation_matrices(quats) * scales[:, None, :])  # [M, 3, 3]

    # The Jacobian is taken no further out than 15 % of the image beyond its border.
    fx, fy, cx, cy = Ks[:, 0, 0], Ks[:, 1, 1], Ks[:, 0, 2], Ks[:, 1, 2]
    margin_x, margin_y = 0.3 * 0.5 * width / fx, 0.3 * 0.5 * height / fy
    tan_x = torch.clamp(x / z, min=-(cx / fx + margin_x), max=(width - cx) / fx + margin_x)
    tan_y = torch.clamp(y / z, min=-(cy / fy + margin_y), max=(height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * tan_x / z, zero, fy / z, -fy * tan_y / z], dim=-1)
    flat = jacobian.reshape(-1, 2, 3) @ axes
    covariance = flat @ flat.transpose(-1, -2)  # [M, 2, 2]

    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    sharp_determinant = xx * yy - xy * xy
    xx, yy = xx + eps2d, yy + eps2d
    determinant = xx * yy - xy * xy
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
    """Real spherical harmonics (Sloan, JCGT 2013). [M, 3], [M, K, 3] -> [M, 3]; K >= (degree + 1)^2."""
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


class _AbsoluteRows(NamedTuple):
    """Where the per-pixel gradients of some rows of means2d add up as absolute values."""

    means2d: Tensor
    index: Any

    def add(self, rows: Tensor, order: Tensor) -> None:
        added = torch.zeros_like(rows).index_copy(0, order, rows)
        self.means2d.absgrad[self.index] += added  # type: ignore[attr-defined]


class _OneCopyPerPixel(torch.autograd.Function):
    """[M, 2] -> [P, M, 2]; its backward sees every pixel's own gradient, whose absolute values are wanted."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, n_pixels: int, absolute: _AbsoluteRows, order: Tensor) -> Tensor:
        ctx.absolute, ctx.order = absolute, order
        return means2d.expand(n_pixels, *means2d.shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        if ctx.absolute is not None:
            ctx.absolute.add(grads[0].abs().sum(0), ctx.order)
        return grads[0].sum(0), None, None, None


def composite(
    projected: Projected,  # M rows
    features: Tensor,  # [M, D]
    background: Tensor,  # [D]
    width: int,
    height: int,
    absolute: _AbsoluteRows | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend all rows into all pixels front to back. Returns image [H, W, D] and alpha [H, W, 1]."""
    order = torch.sort(projected.depths.detach(), stable=True).indices
    means2d, _, conics, opacities, _ = (t[order] for t in projected)
    features = features[order]

    def blend(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor, features: Tensor) -> Tensor:
        alpha = _alphas(
            pixels, _OneCopyPerPixel.apply(means2d, len(pixels), absolute, order), conics, opacities
        )
        alpha = torch.where(alpha >= ALPHA_THRESHOLD, alpha.clamp_max(ALPHA_MAX), 0.0)
        with torch.no_grad():
            counted = torch.cumprod(1 - alpha, dim=1) > TRANSMITTANCE_STOP
        alpha = torch.where(counted, alpha, 0.0)
        after = torch.cat([alpha.new_ones(len(pixels), 1), torch.cumprod(1 - alpha, dim=1)], dim=1)
        color = (alpha * after[:, :-1]) @ features + after[:, -1:] * background
        return torch.cat([color, 1 - after[:, -1:]], dim=1)

    parts = [
        checkpoint(blend, pixels, means2d, conics, opacities, features, use_reentrant=False)
        for pixels in _pixel_chunks(width, height, len(order), means2d)
    ]
    image = torch.cat(parts).reshape(height, width, -1)
    return image[..., :-1], image[..., -1:]


@torch.no_grad()
def near_cutoff(info: dict[str, Any], relative: float = 1e-3, depth_relative: float = 1e-6) -> Tensor:
    """Pixels whose value or gradient may jump under rounding: a comparison should leave them out.

    Args:
        info: What `rasterization_reference` returned beside the images.
        relative: Distance of an alpha to 1/255 or 0.999, and of a transmittance to 1e-4, as a share of it.
        depth_relative: Two Gaussians in one pixel this close in depth may change places.

    Returns:
        Boolean mask. [C, H, W]
    """
    masks = []
    for camera in range(info["n_cameras"]):
        index: Any = (camera, (info["radii"][camera] > 0).all(dim=-1)) if info["camera_ids"] is None else None
        index = info["camera_ids"] == camera if index is None else index
        projected = Projected(*(info[name][index].detach() for name in Projected._fields))
        depths, order = torch.sort(projected.depths, stable=True)
        means2d, _, conics, opacities, _ = (t[order] for t in projected)
        parts = []
        for pixels in _pixel_chunks(info["width"], info["height"], len(order), means2d):
            alpha = _alphas(pixels, means2d, conics, opacities)
            near = (alpha / ALPHA_THRESHOLD - 1).abs() < relative
            near |= (alpha / ALPHA_MAX - 1).abs() < relative
            alpha = torch.where(alpha >= ALPHA_THRESHOLD, alpha.clamp_max(ALPHA_MAX), 0.0)
            near |= (torch.cumprod(1 - alpha, dim=1) / TRANSMITTANCE_STOP - 1).abs() < relative
            # The depth of the nearest contributing Gaussian in front, carried along the sorted row.
            contributing = torch.where(alpha > 0, depths, -torch.inf)
            in_front = torch.cummax(contributing, dim=1).values.roll(1, dims=1)
            tie = (alpha > 0) & (depths - in_front <= depth_relative * depths.abs())
            parts.append(near.any(dim=1) | tie[:, 1:].any(dim=1))
        masks.append(torch.cat(parts).reshape(info["height"], info["width"]))
    return torch.stack(masks)


@torch.no_grad()
def tiles(
    rows: Projected, image_ids: Tensor, n_images: int, width: int, height: int, tile_size: int
) -> dict[str, Any]:
    """The tiles every Gaussian's box touches, sorted by image, tile and depth, in gsplat's encoding."""
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
    places = (image_ids[flatten_ids] << tile_bits) | tile_ids
    isect_ids, order = torch.sort((places << 32) | depth_bits, stable=True)
    n_tiles = tile_width * tile_height
    per_tile = torch.bincount(image_ids[flatten_ids] * n_tiles + tile_ids, minlength=n_images * n_tiles)
    return {
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": count.to(torch.int32).reshape(rows.depths.shape),
        "isect_ids": isect_ids,
        "flatten_ids": flatten_ids[order].to(torch.int32),
        "isect_offsets": (per_tile.cumsum(0) - per_tile)
        .reshape(n_images, tile_height, tile_width)
        .to(torch.int32),
    }


def _scatter(
    rows: Tensor, camera_ids: Tensor, gaussian_ids: Tensor, n_cameras: int, n_gaussians: int
) -> Tensor:
    dense = rows.new_zeros(n_cameras, n_gaussians, *rows.shape[1:])
    return dense.index_put((camera_ids, gaussian_ids), rows)


def _alphas(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    dx, dy = (pixels[:, None, :] - means2d).unbind(-1)  # [P, M]
    a, b, c = conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    return torch.where(sigma >= 0, opacities * torch.exp(-sigma), 0.0)


def _pixel_chunks(width: int, height: int, n_gaussians: int, like: Tensor) -> Iterator[Tensor]:
    rows, columns = torch.arange(height), torch.arange(width)
    grid = torch.cartesian_prod(rows, columns).flip(-1).to(like)
    yield from (grid + 0.5).split(max(1, PAIRS_PER_CHUNK // max(1, n_gaussians)))
