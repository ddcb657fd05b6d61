"""The rasterizer as a trainer needs it: one camera, raw parameters, and nothing written for rows that no pixel needs.

`rasterization` gives every intermediate tensor to its caller, with rows for all Gaussians. Here scales and opacities
come as logarithms and logits, whose activations and adjoints happen in the kernels, intermediate rows are written for
visible Gaussians only, and the gradients of the parameters are the only tensors of N rows that the backward fills.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .autograd import check_shapes
from .runtime.arguments import as_kernels_read, camera_centre, check_tensors, planes
from .runtime.buffers import floats, ints, zeros
from .runtime.constants import FACTOR, TILE, blocks, tiles
from .runtime.optimizations import active_optimizations
from .stages.project import project_forward
from .stages.rendering import blend, pair_sums
from .stages.rows import take_rows, visible_rows
from .stages.sh import sh_forward
from .stages.splat_backward import splat_backward
from .training.factored_gradient import Factors
from .training.lazy_adam import LazyAdam

EPS2D = 0.3  # added to the 2D covariance's diagonal, square pixels


@dataclass
class _Projected:
    """Rows [N, ...] of which only the visible ones are written, and which these are."""

    means2d: Tensor
    depths: Tensor
    conics: Tensor
    sigmas: Tensor
    compensations: Tensor
    radii: Tensor
    opacities: Tensor
    visible: Tensor
    block_start: Tensor


def rasterize_splats(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    log_scales: Tensor,  # [N, 3]
    logits: Tensor,  # [N]
    sh0: Tensor,  # [N, 1, 3]
    shN: Tensor,  # [N, K - 1, 3]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    sh_degree: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    background: Tensor | None = None,  # [3]
    antialiased: bool = False,
    absgrad: bool = False,
    lazy: LazyAdam | None = None,
    with_rows: bool = True,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Renders raw parameters of 3DGS into one camera, as `rasterization` renders their activations.

    Differentiable in means, quats, log_scales, logits, sh0 and shN; bit-equal for any number of threads.

    Args:
        means: Centres in world space.
        quats: Rotations w, x, y, z of any length.
        log_scales: Logarithms of the standard deviations in world units.
        logits: Of the opacities.
        sh0: Constant band of the colours.
        shN: The other bands.
        viewmat: World to camera.
        K: Intrinsics in pixels.
        width: Image width in pixels.
        height: Image height in pixels.
        sh_degree: 0 to 3.
        near_plane: Gaussians nearer than this are left out, world units; those behind the camera always are.
        far_plane: Gaussians farther than this are left out, world units.
        background: Colour behind everything; black if None.
        antialiased: Scale opacities by the area lost to the blur of 0.3 square pixels.
        absgrad: Also add up |gradient| of the 2D means over pixels, in `info["means2d"].absgrad`.
        lazy: The optimizer of `shN`, where this is its parameter. Visible rows are caught up before they are read, and
            the backward pass hands the gradient to it in factors, past autograd, which asks for all numbers.
        with_rows: Whether the dictionary has a row for each of M visible Gaussians, as densification and optimizers of
            visible rows want it; `absgrad` needs it.

    Returns:
        Image [H, W, 3], transmittance [H, W], which is 1 - alpha, and a dictionary as gsplat's packed mode has it:
        camera_ids [M], gaussian_ids [M], radii [M, 2], means2d [M, 2], a leaf with a gradient after the backward pass,
        all four only `with_rows`; width, height, n_cameras.

    Raises:
        ValueError: A shape, dtype or device does not fit, the camera is not finite or cannot be inverted, or a plane is
            no number.
    """
    tensors = (means, quats, log_scales, logits, sh0, shN)
    check_tensors(
        means, quats, log_scales, logits, sh0, viewmat[None], K[None], sh_degree, shN,
        None if background is None else background[None], width, height,
    )  # fmt: skip
    near_plane, far_plane = planes(near_plane, far_plane)
    means, quats, log_scales, logits, sh0, shN, viewmat, K = as_kernels_read(*tensors, viewmat, K)
    size = (width, height)
    with torch.no_grad():
        projected = _project(
            means, quats, log_scales, logits, viewmat, K, size, near_plane, far_plane, antialiased, with_rows
        )
    visible = projected.visible
    if lazy is not None and sh_degree > 0:
        lazy.catch_up(visible)
    tile_width, tile_height = tiles(width, height)
    info: dict[str, Any] = {
        "width": width,
        "height": height,
        "n_cameras": 1,
        "tile_size": TILE,
        "tile_width": tile_width,
        "tile_height": tile_height,
    }
    centres = absolute = None
    if with_rows:
        # A leaf that goes in with the parameters, so that its gradient comes out with theirs.
        centres = take_rows(projected.means2d, visible)
        centres.requires_grad_(torch.is_grad_enabled() and any(t.requires_grad for t in tensors))
        if absgrad:
            absolute = centres.absgrad = zeros(len(visible), 2)  # type: ignore[attr-defined]
        ids = visible.to(torch.int64)
        info |= {
            "camera_ids": torch.zeros_like(ids),
            "gaussian_ids": ids,
            "radii": take_rows(projected.radii, visible),
            "means2d": centres,
        }
    image, transmittance = _Render.apply(
        means, quats, log_scales, logits, sh0, shN, centres, absolute, projected, viewmat, K, size, sh_degree,
        antialiased, lazy,
    )  # fmt: skip
    if background is not None:
        image = image + transmittance.unsqueeze(-1) * background.to(torch.float32)
    return image, transmittance, info


class _Render(torch.autograd.Function):
    """Image [H, W, 3] of projected Gaussians and the transmittance [H, W] behind it.

    `absolute` [M, 2] receives the sum over pixels of |v_centres| when it is not None, `lazy` the gradient of `shN`.
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        logits: Tensor,
        sh0: Tensor,
        shN: Tensor,
        centres: Tensor | None,
        absolute: Tensor | None,
        projected: _Projected,
        viewmat: Tensor,
        K: Tensor,
        size: tuple[int, int],
        degree: int,
        antialiased: bool,
        lazy: LazyAdam | None,
    ) -> tuple[Tensor, Tensor]:
        p, n = projected, len(means)
        camera = camera_centre(viewmat).contiguous()
        colors = floats(n, 3)
        layout = (3, 3 * shN.shape[1], 0)
        sh_forward(means, camera, sh0, shN, p.visible, p.block_start, colors, n, *layout, degree, 0)
        image, transmittance, _, ctx.blended = blend(
            p.means2d, p.conics, p.opacities, colors, p.depths, p.sigmas, p.visible, p.block_start, *size, dense=False
        )
        ctx.save_for_backward(means, quats, log_scales, logits, sh0, shN, transmittance)
        ctx.shapes = {
            name: tensor.shape
            for name, tensor in zip(("means", "quats", "scales", "opacities", "sh0", "shN"), ctx.to_save, strict=False)
        }
        ctx.projected, ctx.colors, ctx.absolute = projected, colors, absolute
        ctx.with_centres = centres is not None
        ctx.camera = camera, viewmat, K, size, antialiased
        ctx.sh = layout, degree, lazy
        ctx.set_materialize_grads(False)  # the transmittance has a gradient where there is a background
        return image, transmittance

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, v_image: Tensor | None, v_transmittance: Tensor | None
    ) -> Any:
        means, quats, log_scales, logits, sh0, shN, transmittance = check_shapes(ctx.saved_tensors, **ctx.shapes)
        p, n = ctx.projected, len(means)
        camera, viewmat, K, size, antialiased = ctx.camera
        layout, degree, lazy = ctx.sh
        gradients = [floats(*t.shape) for t in (means, quats, log_scales, logits, sh0)]
        rows = p.visible if lazy is not None and degree > 0 else p.visible[:0]
        factors = Factors(rows, floats(len(rows), FACTOR), floats(len(rows), FACTOR), degree)
        v_shN = floats(*shN.shape) if lazy is None else floats(0)
        with_absolute = ctx.absolute is not None
        absolute = ctx.absolute if with_absolute else floats(0)
        v_centres = floats(len(p.visible) if ctx.with_centres else 0, 2)
        # Three channels are one pass.
        ((_, _, sums),) = pair_sums(ctx.blended, ctx.colors, transmittance, v_image, v_transmittance, with_absolute)
        splat_backward(
            *sums, means, quats, log_scales, logits, sh0, shN, viewmat, K, camera, ctx.colors, p.conics, p.opacities,
            *gradients, v_shN, factors.directions, factors.colors, v_centres, absolute,
            n, *map(float, size), EPS2D, layout[1], degree, int(lazy is not None), int(antialiased),
            int(ctx.with_centres), int(with_absolute), ctx.blended.parts, active_optimizations(),
        )  # fmt: skip
        if lazy is not None:
            lazy.receive(factors)
        return *gradients, v_shN if lazy is None else None, v_centres if ctx.with_centres else None, *[None] * 8


def _project(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logits: Tensor,
    viewmat: Tensor,
    K: Tensor,
    size: tuple[int, int],
    near_plane: float,
    far_plane: float,
    antialiased: bool,
    with_radii: bool,
) -> _Projected:
    n = len(means)
    means2d, depths, conics, sigmas, opacities = floats(n, 2), floats(n), floats(n, 3), floats(n, 2), floats(n)
    compensations, radii = floats(n if antialiased else 0), ints(n if with_radii else 0, 2)
    seen, block_count = ints(n), ints(blocks(n))
    project_forward(
        means, quats, log_scales, logits, viewmat, K, means2d, depths, conics, sigmas, compensations, radii,
        opacities, seen, block_count, n, *map(float, size), near_plane, far_plane, EPS2D, 0.0, int(antialiased),
        1, 0, int(with_radii), active_optimizations(),
    )  # fmt: skip
    lists = visible_rows(seen, block_count)
    return _Projected(means2d, depths, conics, sigmas, compensations, radii, opacities, *lists)
