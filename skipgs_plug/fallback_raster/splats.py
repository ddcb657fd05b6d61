"""The rasterizer for a trainer: one camera, raw parameters, and intermediate results of visible Gaussians only.

`rasterization` returns every intermediate tensor with rows for all Gaussians. Here scales and opacities are given as
logarithms and logits, and the kernels contain the activations and their adjoints. Intermediate rows are written for
visible Gaussians only. The gradients of the parameters are the only tensors with N rows that the backward pass fills.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from .autograd import check_shapes
from .runtime.arguments import as_kernels_read, camera_centre, check_tensors, planes
from .runtime.buffers import floats, ints, zeros
from .runtime.constants import FACTOR_FLOATS, TILE, blocks, tiles
from .runtime.function_modes import without_function_modes
from .runtime.optimizations import active_optimizations
from .stages.compose import compose, pair_sums
from .stages.project import Limits, Projected, ProjectFlags, project_forward
from .stages.rows import take_rows, visible_rows
from .stages.sh import sh_forward
from .stages.splat_adjoint import CenterGradients, Rendered, SplatAdjointFlags, splat_adjoint
from .stages.structs import (
    BlockRows,
    Camera,
    FactorOutput,
    GaussianGradients,
    Gaussians,
    Harmonics,
    HarmonicsGradients,
    RowList,
    Splats,
)
from .training.factored_gradient import Factors
from .training.lazy_adam import LazyAdam

# Added to the diagonal of the 2D covariance, in square pixels. All 3DGS trainers use this low-pass filter.
EPS2D = 0.3


@dataclass
class _View:
    """Gaussians projected into one camera: tensors with N rows, of which only the visible rows are written."""

    camera: Camera
    antialiased: bool
    projected: Projected
    visible: RowList

    @property
    def splats(self) -> Splats:
        """The projected splats that the blend reads."""
        p = self.projected
        return Splats(p.means2d, p.depths, p.conics, p.opacities, p.sigmas)


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
    """Render raw 3DGS parameters into one camera. `rasterization` renders the same image from activated parameters.

    Differentiable in means, quats, log_scales, logits, sh0 and shN. Bit-equal for any number of threads.

    Args:
        means: Centres [N, 3] in world space.
        quats: Rotations [N, 4], w, x, y, z of any length.
        log_scales: Logarithms [N, 3] of the standard deviations in world units.
        logits: Logits [N] of the opacities.
        sh0: SH coefficients [N, 1, 3] of degree 0.
        shN: SH coefficients [N, K - 1, 3] of the higher degrees.
        viewmat: Matrix [4, 4] from world to camera, x right, y down, z forward.
        K: Intrinsics [3, 3] in pixels; pixel centres lie at +0.5.
        width: Image width in pixels.
        height: Image height in pixels.
        sh_degree: Degree of the SH that are evaluated, 0 to 3.
        near_plane: Gaussians nearer than this are culled, world units. Gaussians behind the camera always are.
        far_plane: Gaussians farther than this are culled, world units.
        background: Colour [3] behind all Gaussians; black if None.
        antialiased: Scale opacities down for the area that the low-pass filter of 0.3 square pixels adds
            (Mip-Splatting).
        absgrad: Also sum the absolute gradients of the 2D means over pixels (AbsGS), in `info["means2d"].absgrad`.
            Needs `with_rows`.
        lazy: The optimizer of `shN`, if it is a `LazyAdam`. Visible rows are caught up before they are read. The
            backward pass hands the gradient of `shN` to it in factors and not through autograd, which would need all
            its numbers.
        with_rows: Whether the dictionary has tensors with a row for each of the M visible Gaussians. Densification and
            optimizers of visible rows need them.

    Returns:
        Image [H, W, 3], transmittance [H, W] (1 - alpha), and a dictionary with entries of gsplat's packed mode: width,
        height, n_cameras and, if `with_rows`, camera_ids [M], gaussian_ids [M], radii [M, 2] and means2d [M, 2], a leaf
        that has a gradient after the backward pass.

    Raises:
        ValueError: A shape, dtype or device is wrong, the camera is not finite or not invertible, or a plane is not a
            number.
    """
    tensors = (means, quats, log_scales, logits, sh0, shN)
    check_tensors(
        means, quats, log_scales, logits, sh0, viewmat[None], K[None], sh_degree, shN,
        None if background is None else background[None], width, height,
    )  # fmt: skip
    near_plane, far_plane = planes(near_plane, far_plane)
    means, quats, log_scales, logits, sh0, shN, viewmat, K = as_kernels_read(*tensors, viewmat, K)
    with torch.no_grad():
        camera = Camera(viewmat, K, float(width), float(height), EPS2D)
        gaussians = Gaussians(means, quats, log_scales)
        limits = Limits(near_plane, far_plane, radius_clip=0.0)
        view = _project(gaussians, logits, camera, limits, antialiased, with_rows)
    visible = view.visible.rows
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
        # A leaf that is an input beside the parameters, so that the backward pass returns its gradient with theirs.
        centres = take_rows(view.projected.means2d, visible)
        centres.requires_grad_(torch.is_grad_enabled() and any(t.requires_grad for t in tensors))
        if absgrad:
            absolute = centres.absgrad = zeros(len(visible), 2)  # type: ignore[attr-defined]
        ids = visible.to(torch.int64)
        info |= {
            "camera_ids": torch.zeros_like(ids),
            "gaussian_ids": ids,
            "radii": take_rows(view.projected.radii, visible),
            "means2d": centres,
        }
    image, transmittance = _Render.apply(
        means, quats, log_scales, logits, sh0, shN, centres, absolute, view, (width, height), sh_degree, lazy
    )
    if background is not None:
        image = image + transmittance.unsqueeze(-1) * background.to(torch.float32)
    return image, transmittance, info


class _Render(torch.autograd.Function):
    """Blends projected Gaussians to an image [H, W, 3] and a transmittance map [H, W].

    If `absolute` [M, 2] is not None, the backward pass adds the sum over pixels of |v_means2d| to it. If `lazy` is not
    None, it receives the gradient of `shN`.
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
        view: _View,
        size: tuple[int, int],
        degree: int,
        lazy: LazyAdam | None,
    ) -> tuple[Tensor, Tensor]:
        position = camera_centre(view.camera.viewmat).contiguous()
        layout = {"sh0_stride": 3, "shN_stride": 3 * shN.shape[1], "shN_offset": 0, "degree": degree}
        colors, n = floats(len(means), 3), len(means)
        sh = Harmonics(position, sh0, shN, **layout)
        sh_forward(means=means, sh=sh, visible=view.visible, colors=colors, n=n, dense=0)
        image, transmittance, _, ctx.composed = compose(view.splats, colors, view.visible, *size, dense=False)
        ctx.save_for_backward(means, quats, log_scales, logits, sh0, shN, transmittance)
        ctx.shapes = {
            name: tensor.shape
            for name, tensor in zip(("means", "quats", "scales", "opacities", "sh0", "shN"), ctx.to_save, strict=False)
        }
        ctx.view, ctx.colors, ctx.absolute = view, colors, absolute
        ctx.with_centres = centres is not None
        ctx.sh = position, layout, lazy
        ctx.set_materialize_grads(False)  # the transmittance has a gradient only if there is a background
        return image, transmittance

    @staticmethod
    @without_function_modes
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, v_image: Tensor | None, v_transmittance: Tensor | None
    ) -> Any:
        means, quats, log_scales, logits, sh0, shN, transmittance = check_shapes(ctx.saved_tensors, **ctx.shapes)
        view: _View = ctx.view
        position, layout, lazy = ctx.sh
        absolute, with_centres, degree = ctx.absolute, ctx.with_centres, layout["degree"]
        # Three channels need a single pass.
        passes = pair_sums(ctx.composed, ctx.colors, transmittance, v_image, v_transmittance, absolute is not None)
        ((_, sums),) = passes
        v_gaussians = GaussianGradients(floats(*means.shape), floats(*quats.shape), floats(*log_scales.shape))
        v_logits, v_sh0 = floats(*logits.shape), floats(*sh0.shape)
        v_shN = floats(*shN.shape) if lazy is None else floats(0)
        rows = view.visible.rows if lazy is not None and degree > 0 else view.visible.rows[:0]
        factors = FactorOutput(floats(len(rows), FACTOR_FLOATS), floats(len(rows), FACTOR_FLOATS))
        v_centres = floats(len(sums.rows) if with_centres else 0, 2)
        splat_adjoint(
            sums=sums,
            gaussians=Gaussians(means, quats, log_scales),
            logits=logits,
            camera=view.camera,
            sh=Harmonics(position, sh0, shN, **layout),
            rendered=Rendered(ctx.colors, view.projected.conics, view.projected.opacities),
            v_gaussians=v_gaussians,
            v_logits=v_logits,
            v_sh=HarmonicsGradients(v_sh0, v_shN, factored=int(lazy is not None)),
            factors=factors,
            v_centers=CenterGradients(v_centres, floats(0) if absolute is None else absolute),
            n=len(means),
            flags=SplatAdjointFlags(
                antialiased=int(view.antialiased),
                with_centers=int(with_centres),
                absgrad=int(absolute is not None),
                optimizations=active_optimizations(),
            ),
        )
        if lazy is not None:
            lazy.receive(Factors(rows, *factors, degree))
        return (
            *v_gaussians,
            v_logits,
            v_sh0,
            v_shN if lazy is None else None,
            v_centres if with_centres else None,
            *[None] * 5,
        )


def _project(
    gaussians: Gaussians, logits: Tensor, camera: Camera, limits: Limits, antialiased: bool, with_radii: bool
) -> _View:
    n = len(logits)
    projected = Projected(
        means2d=floats(n, 2),
        depths=floats(n),
        conics=floats(n, 3),
        sigmas=floats(n, 2),
        compensations=floats(n if antialiased else 0),
        radii=ints(n if with_radii else 0, 2),
        opacities=floats(n),
    )
    found = BlockRows(ints(n), ints(blocks(n)))
    project_forward(
        gaussians=gaussians,
        opacities=logits,
        camera=camera,
        limits=limits,
        projected=projected,
        found=found,
        n=n,
        flags=ProjectFlags(
            int(antialiased), raw=1, dense=0, with_radii=int(with_radii), optimizations=active_optimizations()
        ),
    )
    return _View(camera, antialiased, projected, visible_rows(found))
