"""The differentiable steps of the rasterizer as torch.autograd.Functions.

Every step allocates its outputs and gradients itself. It never writes to a tensor of the caller, except `absolute`.
Inputs are saved with `save_for_backward`, so that torch notices when one is changed in place between forward and
backward.
"""

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .runtime.buffers import floats, ints, zeros
from .runtime.constants import blocks
from .runtime.function_modes import without_function_modes
from .runtime.optimizations import OPTIMIZATIONS, active_optimizations
from .stages.compose import compose, compose_adjoint
from .stages.project import Limits, Projected, ProjectFlags, project_adjoint, project_forward
from .stages.rows import all_rows, put_rows, take_rows, visible_rows
from .stages.sh import sh_adjoint, sh_forward
from .stages.structs import (
    BlockRows,
    Camera,
    GaussianGradients,
    Gaussians,
    Harmonics,
    HarmonicsGradients,
    ProjectAdjointFlags,
    ProjectedGradients,
    RowList,
    Splats,
)


def check_shapes(tensors: tuple[Tensor, ...], **shapes: torch.Size) -> tuple[Tensor, ...]:
    """Return the saved tensors after checking that inputs still have the shapes that the forward pass saw.

    Torch notices changes in place, but it does not notice when `.data` is replaced, as code that densifies does.

    Raises:
        RuntimeError: The shape of a tensor changed.
    """
    for tensor, (name, shape) in zip(tensors, shapes.items(), strict=False):
        if tensor.shape != shape:
            raise RuntimeError(
                f"{name} had shape {list(shape)} when it was rendered and has {list(tensor.shape)} now: call "
                "backward() before the number of Gaussians changes."
            )
    return tensors


class Project(torch.autograd.Function):
    """Projects Gaussians onto the image plane of one camera (EWA splatting, Zwicker et al. 2001).

    Returns means2d [1, N, 2], depths [1, N], conics [1, N, 3] and compensations [1, N] (empty unless antialiased). Also
    returns, without gradients, radii [1, N, 2], sigmas [1, N, 2] (standard deviations in pixels), the visible rows [M],
    and where each block of rows begins in that list [ceil(N / BLOCK_ROWS) + 1].
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,  # [N, 3]
        quats: Tensor,  # [N, 4]
        scales: Tensor,  # [N, 3]
        opacities: Tensor,  # [N], only decides which Gaussians are visible
        viewmat: Tensor,  # [1, 4, 4]
        K: Tensor,  # [1, 3, 3]
        width: int,
        height: int,
        near_plane: float,
        far_plane: float,
        eps2d: float,
        radius_clip: float,
        antialiased: bool,
    ) -> tuple[Tensor, ...]:
        n = len(means)
        projected = Projected(
            means2d=floats(1, n, 2),
            depths=floats(1, n),
            conics=floats(1, n, 3),
            sigmas=floats(1, n, 2),
            compensations=floats(1, n if antialiased else 0),
            radii=ints(1, n, 2),
            opacities=floats(0),
        )
        found = BlockRows(ints(n), ints(blocks(n)))
        project_forward(
            gaussians=Gaussians(means, quats, scales),
            opacities=opacities,
            camera=Camera(viewmat, K, float(width), float(height), eps2d),
            limits=Limits(near_plane, far_plane, radius_clip),
            projected=projected,
            found=found,
            n=n,
            flags=ProjectFlags(int(antialiased), raw=0, dense=1, with_radii=1, optimizations=active_optimizations()),
        )
        visible, block_start = visible_rows(found)
        means2d, depths, conics, sigmas, compensations, radii, _ = projected
        ctx.save_for_backward(means, quats, scales, viewmat, K, visible, block_start)
        ctx.shapes = {"means": means.shape, "quats": quats.shape, "scales": scales.shape, "viewmats": viewmat.shape}
        ctx.size = (width, height, eps2d)
        ctx.mark_non_differentiable(radii, sigmas, visible, block_start)
        ctx.set_materialize_grads(False)  # depths rarely have a gradient, and zeros would cost time
        return means2d, depths, conics, compensations, radii, sigmas, visible, block_start

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any,
        v_means2d: Tensor | None,
        v_depths: Tensor | None,
        v_conics: Tensor | None,
        v_compensations: Tensor | None,
        *_: Any,
    ) -> Any:
        means, quats, scales, viewmat, K, visible, block_start = check_shapes(ctx.saved_tensors, **ctx.shapes)
        width, height, eps2d = ctx.size
        with_pose = ctx.needs_input_grad[4]
        n = len(means)
        v_gaussians = GaussianGradients(*(floats(*t.shape) for t in (means, quats, scales)))
        v_poses = zeros(blocks(n) if with_pose else 0, 3, 4)
        v_projected = ProjectedGradients(
            means2d=zeros(n, 2) if v_means2d is None else v_means2d.contiguous(),
            depths=floats(0) if v_depths is None else v_depths.contiguous(),
            conics=zeros(n, 3) if v_conics is None else v_conics.contiguous(),
            compensations=floats(0) if v_compensations is None else v_compensations.contiguous(),
            opacities=floats(0),
        )
        project_adjoint(
            gaussians=Gaussians(means, quats, scales),
            camera=Camera(viewmat, K, float(width), float(height), eps2d),
            visible=RowList(visible, block_start),
            v_projected=v_projected,
            v_gaussians=v_gaussians,
            v_poses=v_poses,
            n=n,
            flags=ProjectAdjointFlags(
                with_depth=int(v_projected.depths.numel() > 0),
                antialiased=int(v_projected.compensations.numel() > 0),
                with_pose=int(with_pose),
                optimizations=active_optimizations(),
            ),
        )
        v_viewmat = None
        if with_pose:
            v_viewmat = zeros(1, 4, 4)
            v_viewmat[0, :3] = v_poses.sum(0)
        return *v_gaussians, None, v_viewmat, *[None] * 8


class SphericalHarmonics(torch.autograd.Function):
    """Evaluates view-dependent colours [N, 3] for one camera.

    The SH coefficients are `sh0` [N, K, 3] with `shN` None, or `sh0` [N, 1, 3] and `shN` [N, K - 1, 3].
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: Tensor,  # [N, 3]
        position: Tensor,  # [3], of the camera
        sh0: Tensor,
        shN: Tensor | None,
        visible: Tensor,  # [M]
        block_start: Tensor,  # [ceil(N / BLOCK_ROWS) + 1]
        degree: int,
    ) -> Tensor:
        n = len(means)
        colors = floats(n, 3)
        if not active_optimizations() & OPTIMIZATIONS["visible_only"]:
            visible, block_start = all_rows(n)
        whole = 3 * sh0.shape[1]
        strides = (whole, whole, 3) if shN is None else (whole, 3 * shN.shape[1], 0)
        ctx.layout = dict(zip(("sh0_stride", "shN_stride", "shN_offset"), strides, strict=True)) | {"degree": degree}
        ctx.joined = shN is None
        shN = sh0 if shN is None else shN
        sh_forward(
            means=means,
            sh=Harmonics(position, sh0, shN, **ctx.layout),
            visible=RowList(visible, block_start),
            colors=colors,
            n=n,
            dense=1,
        )
        ctx.save_for_backward(means, sh0, shN, position, colors, visible, block_start)
        ctx.shapes = {"means": means.shape, "colors": sh0.shape, "the higher bands of colors": shN.shape}
        return colors

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> Any:  # type: ignore[override]
        means, sh0, shN, position, colors, visible, block_start = check_shapes(ctx.saved_tensors, **ctx.shapes)
        v_means, v_sh0 = floats(*means.shape), floats(*sh0.shape)
        v_shN = v_sh0 if ctx.joined else floats(*shN.shape)
        v_positions = zeros(blocks(len(means)), 3)
        sh_adjoint(
            means=means,
            sh=Harmonics(position, sh0, shN, **ctx.layout),
            visible=RowList(visible, block_start),
            colors=colors,
            v_colors=v_colors.contiguous(),
            v_means=v_means,
            v_sh=HarmonicsGradients(v_sh0, v_shN, factored=0),
            v_positions=v_positions,
            n=len(means),
            optimizations=active_optimizations(),
        )
        v_position = v_positions.sum(0) if ctx.needs_input_grad[1] else None
        return v_means, v_position, v_sh0, None if ctx.joined else v_shN, None, None, None


class Pack(torch.autograd.Function):
    """Selects the visible rows [M, ...] of a tensor [N, ...] of one camera, for gsplat's packed mode."""

    @staticmethod
    def forward(ctx: Any, tensor: Tensor, visible: Tensor, block_start: Tensor) -> Tensor:  # type: ignore[override]
        ctx.save_for_backward(visible, block_start)
        ctx.n = len(tensor)
        return take_rows(tensor, visible)

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(ctx: Any, v_packed: Tensor) -> Any:  # type: ignore[override]
        visible, block_start = ctx.saved_tensors
        return put_rows(v_packed, ctx.n, RowList(visible, block_start)), None, None


class Blend(torch.autograd.Function):
    """Blends projected Gaussians to an image [1, H, W, D] and an alpha map [1, H, W, 1] of one camera.

    Also returns tiles_per_gauss [R]. Row tensors may have a leading dimension of one camera: views without it, whose
    gradients are views too, would take as long as a small kernel. If `absolute` [R, 2] is not None, the backward pass
    adds the sum over pixels of |v_means2d| to it (AbsGS).
    """

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means2d: Tensor,  # [R, 2]
        conics: Tensor,  # [R, 3]
        opacities: Tensor,  # [R]
        colors: Tensor,  # [R, D]
        depths: Tensor,  # [R]
        sigmas: Tensor,  # [R, 2]
        visible: Tensor,  # [M]
        block_start: Tensor,  # [ceil(R / BLOCK_ROWS) + 1]
        width: int,
        height: int,
        absolute: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        splats = Splats(means2d, depths, conics, opacities, sigmas)
        image, transmittance, alpha, ctx.composed = compose(
            splats, colors, RowList(visible, block_start), width, height
        )
        ctx.save_for_backward(means2d, conics, opacities, colors, transmittance)
        ctx.shapes = {
            "means2d": means2d.shape,
            "conics": conics.shape,
            "opacities": opacities.shape,
            "colors": colors.shape,
        }
        ctx.absolute = absolute
        tiles_per_gauss = ctx.composed.near.bins.tiles_per_gauss
        ctx.mark_non_differentiable(tiles_per_gauss)
        ctx.set_materialize_grads(False)  # zeros for tiles_per_gauss [R] would cost time
        return image, alpha, tiles_per_gauss

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, v_image: Tensor | None, v_alpha: Tensor | None, _: Any
    ) -> Any:
        means2d, conics, opacities, colors, transmittance = check_shapes(ctx.saved_tensors, **ctx.shapes)
        v_transmittance = None if v_alpha is None else -v_alpha
        gradients = compose_adjoint(
            ctx.composed, means2d, conics, opacities, colors, transmittance, v_image, v_transmittance, ctx.absolute
        )
        return *gradients, *[None] * 7
