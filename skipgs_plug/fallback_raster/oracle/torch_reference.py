"""Gaussian splatting in plain PyTorch, for every dtype: the oracle with which the fast rasterizer is compared.

It restates the mathematics of gsplat 1.5.3's CUDA kernels as directly as possible: it projects every Gaussian, sorts by
depth, and blends every Gaussian into every pixel that its box can touch. Autograd derives the backward pass, so there
is little to get wrong. It is slow and meant for small images. In float64 its error is far below the rounding error of a
float32 rasterizer.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .torch_reference_projection import ALPHA_THRESHOLD, Projected, project, spherical_harmonics, tiles

# Cut-offs of gsplat and Inria's rasterizer, without units. Alpha is clamped at ALPHA_MAX. The first Gaussian that would
# reduce the transmittance to TRANSMITTANCE_STOP or less ends the pixel and is not blended.
ALPHA_MAX = 0.999
TRANSMITTANCE_STOP = 1e-4
# Pixels along each side of the squares that are blended at a time. This bounds the memory, which is a few tensors of
# SQUARE^2 x M numbers for the M Gaussians that reach the square.
SQUARE = 16
# Difference of two depths, as a share of the depth, below which rounding to float32 may swap two Gaussians: 8 of its
# steps of 1.2e-7.
SAME_DEPTH = 1e-6


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

    # Remove culled Gaussians before anything is differentiated: their gradient is 0, and a depth of 0 would make it
    # NaN.
    every_row = torch.cartesian_prod(torch.arange(n_cameras), torch.arange(n_gaussians)).to(means.device)
    with torch.no_grad():
        visible = (project_rows(*every_row.T).radii > 0).all(dim=-1)
    camera_ids, gaussian_ids = every_row[visible].T
    rows = project_rows(camera_ids, gaussian_ids)

    if sh_degree is None:
        features = colors[gaussian_ids] if colors.dim() == 2 else colors[camera_ids, gaussian_ids]
    else:
        coeffs = colors[gaussian_ids] if colors.dim() == 3 else colors[camera_ids, gaussian_ids]
        directions = means[gaussian_ids] - torch.inverse(viewmats)[camera_ids, :3, 3]
        features = (spherical_harmonics(sh_degree, directions, coeffs) + 0.5).clamp_min(0.0)

    row_ids = torch.arange(len(camera_ids))  # row of each visible Gaussian in the tensors of `info`, flattened
    if not packed:  # [M, ...] -> [C, N, ...], zero where culled
        row_ids = camera_ids * n_gaussians + gaussian_ids
        shape = n_cameras, n_gaussians
        rows = Projected(*(t.new_zeros(*shape, *t.shape[1:]).index_put((camera_ids, gaussian_ids), t) for t in rows))
    flat = rows if packed else Projected(*(t.flatten(0, 1) for t in rows))
    absolute = None
    if absgrad:
        rows.means2d.absgrad = torch.zeros_like(rows.means2d)  # type: ignore[attr-defined]
        absolute = rows.means2d.absgrad.view(-1, 2)  # type: ignore[attr-defined]

    images, alphas = [], []
    for camera in range(n_cameras):
        here = camera_ids == camera
        image, alpha = _render_camera(
            Projected(*(t[row_ids[here]] for t in flat)),
            features[here],
            None if backgrounds is None else backgrounds[camera],
            width,
            height,
            render_mode,
            row_ids[here],
            absolute,
        )
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


def _render_camera(
    projected: Projected,  # M rows
    features: Tensor,  # [M, D]
    background: Tensor | None,  # [D]
    width: int,
    height: int,
    render_mode: str,
    row_ids: Tensor,  # [M] rows of `absolute`
    absolute: Tensor | None,  # [R, 2] receives the sums of absolute gradients of means2d
) -> tuple[Tensor, Tensor]:
    """Render the colours, the depth, or both. Returns image [H, W, X] and alpha [H, W, 1]."""
    colors = [features] if "RGB" in render_mode else []
    depths = [] if render_mode == "RGB" else [projected.depths[:, None]]
    values = torch.cat([*colors, *depths], -1)
    behind = values.new_zeros(values.shape[-1])  # depth has a background of 0
    if background is not None and colors:
        behind = torch.cat([background, behind[len(background) :]])
    image, alpha = composite(projected, values, behind, width, height, row_ids, absolute)
    if render_mode.endswith("ED"):
        image = torch.cat([image[..., :-1], image[..., -1:] / alpha.clamp(min=1e-10)], dim=-1)
    return image, alpha


class _OneCopyPerPixel(torch.autograd.Function):
    """Copies [M, 2] to [P, M, 2], so that the backward pass sees each pixel's gradient and can sum absolute values."""

    @staticmethod
    def forward(ctx: Any, means2d: Tensor, n_pixels: int, row_ids: Tensor, absolute: Tensor | None) -> Tensor:
        ctx.row_ids, ctx.absolute = row_ids, absolute
        return means2d.expand(n_pixels, *means2d.shape)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None, None]:
        if ctx.absolute is not None:
            ctx.absolute.index_add_(0, ctx.row_ids, grads[0].abs().sum(0))
        return grads[0].sum(0), None, None, None


def composite(
    projected: Projected,  # M rows
    features: Tensor,  # [M, D]
    background: Tensor,  # [D]
    width: int,
    height: int,
    row_ids: Tensor,  # [M] rows of `absolute`
    absolute: Tensor | None,  # [R, 2] receives the sums of absolute gradients of means2d
) -> tuple[Tensor, Tensor]:
    """Blend all rows into all pixels front to back. Returns image [H, W, D] and alpha [H, W, 1]."""
    by_depth = torch.sort(projected.depths.detach(), stable=True).indices

    def blend(pixels: Tensor, order: Tensor, *rows: Tensor) -> Tensor:
        means2d, conics, opacities, features = rows
        copies = _OneCopyPerPixel.apply(means2d, len(pixels), row_ids[order], absolute)
        alpha = _alphas(pixels, copies, conics, opacities)
        alpha = torch.where(alpha >= ALPHA_THRESHOLD, alpha.clamp_max(ALPHA_MAX), 0.0)
        with torch.no_grad():
            counted = torch.cumprod(1 - alpha, dim=1) > TRANSMITTANCE_STOP
        alpha = torch.where(counted, alpha, 0.0)
        after = torch.cat([alpha.new_ones(len(pixels), 1), torch.cumprod(1 - alpha, dim=1)], dim=1)
        color = (alpha * after[:, :-1]) @ features + after[:, -1:] * background
        return torch.cat([color, 1 - after[:, -1:]], dim=1)

    def blend_square(pixels: Tensor) -> Tensor:
        order = by_depth[_reaches(projected, pixels)[by_depth]]
        rows = (projected.means2d, projected.conics, projected.opacities, features)
        return checkpoint(blend, pixels, order, *(t[order] for t in rows), use_reentrant=False)

    image = _image_of_squares(blend_square, width, height, background)
    return image[..., :-1], image[..., -1:]


@torch.no_grad()
def near_cutoff(info: dict[str, Any], relative: float = 1e-3) -> Tensor:
    """Mask pixels whose value or gradient may jump under rounding. A comparison should leave these pixels out.

    They include pixels with two Gaussians whose depths differ by less than SAME_DEPTH.

    Args:
        info: The dictionary that `rasterization_reference` returned.
        relative: Masks pixels in which an alpha is this close to 1/255 or 0.999, or a transmittance to 1e-4, relative
            to it.

    Returns:
        Boolean mask. [C, H, W]
    """
    masks = []
    for camera in range(info["n_cameras"]):
        if info["camera_ids"] is None:
            index: Any = (camera, (info["radii"][camera] > 0).all(dim=-1))
        else:
            index = info["camera_ids"] == camera
        projected = Projected(*(info[name][index].detach() for name in Projected._fields))
        blend_square = partial(_near_cutoff_in_square, projected, relative)
        masks.append(_image_of_squares(blend_square, info["width"], info["height"], projected.depths)[..., 0])
    return torch.stack(masks)


def _near_cutoff_in_square(projected: Projected, relative: float, pixels: Tensor) -> Tensor:
    order = torch.sort(projected.depths, stable=True).indices
    order = order[_reaches(projected, pixels)[order]]
    if len(order) == 0:
        return torch.zeros(len(pixels), 1, dtype=torch.bool)
    means2d, depths, conics, opacities, _ = (t[order] for t in projected)
    alpha = _alphas(pixels, means2d, conics, opacities)
    near = (alpha / ALPHA_THRESHOLD - 1).abs() < relative
    near |= (alpha / ALPHA_MAX - 1).abs() < relative
    alpha = torch.where(alpha >= ALPHA_THRESHOLD, alpha.clamp_max(ALPHA_MAX), 0.0)
    transmittance = torch.cumprod(1 - alpha, dim=1)
    near |= (transmittance / TRANSMITTANCE_STOP - 1).abs() < relative
    # Depth of the nearest blended Gaussian in front, as a running maximum along the sorted row.
    contributing = torch.where(alpha > 0, depths, -torch.inf)
    in_front = torch.cummax(contributing, dim=1).values[:, :-1]
    tie = (alpha > 0)[:, 1:] & (depths[1:] - in_front <= SAME_DEPTH * depths[1:].abs())
    # Gaussians behind the stop are never blended.
    near[:, 1:] |= tie
    reached = transmittance > 0.5 * TRANSMITTANCE_STOP
    return (near & reached).any(dim=1, keepdim=True)


def _reaches(projected: Projected, pixels: Tensor) -> Tensor:
    """Mask the Gaussians whose boxes touch the box of the pixels. Outside its box an alpha is below 1/255."""
    means2d, radii = projected.means2d.detach(), projected.radii
    touching = (means2d + radii >= pixels.amin(dim=0)) & (means2d - radii <= pixels.amax(dim=0))
    return touching.all(dim=-1)


def _alphas(pixels: Tensor, means2d: Tensor, conics: Tensor, opacities: Tensor) -> Tensor:
    dx, dy = (pixels[:, None, :] - means2d).unbind(-1)  # [P, M]
    a, b, c = conics.unbind(-1)
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    # Clamp as well as select: where rounding made sigma negative, the exponential may be infinite.
    return torch.where(sigma >= 0, opacities * torch.exp(-sigma.clamp_min(0.0)), 0.0)


def _image_of_squares(blend_square: Callable[[Tensor], Tensor], width: int, height: int, like: Tensor) -> Tensor:
    """Assemble an image [H, W, X] from squares. `blend_square` maps pixel centres [P, 2] of a square to [P, X]."""
    rows = []
    for top in range(0, height, SQUARE):
        y = torch.arange(top, min(top + SQUARE, height)).to(like) + 0.5
        squares = []
        for left in range(0, width, SQUARE):
            x = torch.arange(left, min(left + SQUARE, width)).to(like) + 0.5
            pixels = torch.cartesian_prod(y, x).flip(-1)
            squares.append(blend_square(pixels).reshape(len(y), len(x), -1))
        rows.append(torch.cat(squares, dim=1))
    return torch.cat(rows)
