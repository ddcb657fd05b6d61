"""`rasterization` with gsplat's signature, on the CPU."""

from collections.abc import Sequence
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from .autograd import Blend, Pack, Project, SphericalHarmonics
from .runtime.arguments import (
    as_float,
    as_int,
    as_kernels_read,
    camera_centre,
    check_tensors,
    planes,
    refuse_unsupported,
)
from .runtime.constants import MAX_CHANNELS, TILE, tiles
from .stages.rows import all_rows

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or ([N, 1, 3], [N, K - 1, 3])
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
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: str = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    with_ut: bool = False,
    with_eval3d: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    ftheta_coeffs: Any = None,
    rolling_shutter: Any = None,
    viewmats_rs: Tensor | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians (Kerbl et al. 2023) into C pinhole cameras, with the arguments and results of gsplat 1.5.

    Computes in float32 on all cores (see `set_num_threads`) and returns the dtype of `means`. The result, images
    and gradients, is bit-equal for any number of threads. Differentiable in means, quats, scales, opacities,
    colors, backgrounds and viewmats.

    Args:
        means: Centres [N, 3] in world space.
        quats: Rotations [N, 4], w, x, y, z of any length; zero stands for no rotation.
        scales: Standard deviations [N, 3] along the axes, world units.
        opacities: Opacities [N] in [0, 1].
        colors: D channels per Gaussian [N, D], or K >= (sh_degree + 1)^2 SH coefficients [N, K, 3]. With a first
            dimension C, each camera has colours of its own. The constant band [N, 1, 3] and the higher bands
            [N, K - 1, 3] may also be a pair of tensors, which saves joining them in every iteration. gsplat does not
            offer that.
        viewmats: Matrices [C, 4, 4] from world to camera, x right, y down, z forward.
        Ks: Intrinsics [C, 3, 3] in pixels; pixel centres lie at +0.5.
        width: Image width in pixels.
        height: Image height in pixels.
        near_plane: Gaussians nearer than this are culled, world units. Gaussians behind the camera always are.
        far_plane: Gaussians farther than this are culled, world units.
        radius_clip: Gaussians whose radii are all at or below this are culled, pixels.
        eps2d: Added to the 2D covariance's diagonal, square pixels.
        sh_degree: 0 to 3 to read `colors` as SH coefficients, None to read them as colours.
        packed: If True, `info` has one row per visible (camera, Gaussian) pair, as in gsplat's packed mode.
        tile_size: Accepted for gsplat's callers and ignored: tiles are always 16 pixels wide.
        backgrounds: Colour [C, D] behind all Gaussians; black if None.
        render_mode: Colour, accumulated depth (D), expected depth (ED), or colour and depth.
        sparse_grad: Not supported.
        absgrad: Also sum the absolute gradients of the 2D means over pixels (AbsGS), in `info["means2d"].absgrad`.
            Needs at most four channels, depth included.
        rasterize_mode: "antialiased" scales opacities down for the area that `eps2d` adds (Mip-Splatting).
        channel_chunk: Accepted for gsplat's callers and ignored: any number of channels works.
        distributed: Not supported. This argument and all unsupported ones below raise an error when they are used.
        camera_model: Only "pinhole".
        segmented: Accepted for gsplat's callers and ignored.
        covars: Not supported.
        with_ut: Not supported.
        with_eval3d: Not supported.
        radial_coeffs: Not supported.
        tangential_coeffs: Not supported.
        thin_prism_coeffs: Not supported.
        ftheta_coeffs: Not supported.
        rolling_shutter: Not supported.
        viewmats_rs: Not supported.

    Returns:
        Colours [C, H, W, X], alphas [C, H, W, 1] and gsplat's dictionary: means2d (with a gradient after backward),
        radii, depths, conics, opacities, tiles_per_gauss, width, height, n_cameras and others. The entries isect_ids,
        flatten_ids and isect_offsets are missing.

    Raises:
        ValueError: A shape, dtype, device or mode is wrong, or a camera is not finite or not invertible.
        NotImplementedError: An option is not supported on the CPU.

    Examples:
        One red Gaussian, one unit in front of a camera at the origin:

        >>> import torch
        >>> from skipgs_plug.fallback_raster import rasterization
        >>> means = torch.tensor([[0.0, 0.0, 1.0]], requires_grad=True)
        >>> image, alpha, info = rasterization(
        ...     means,
        ...     quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        ...     scales=torch.full((1, 3), 0.1),
        ...     opacities=torch.ones(1),
        ...     colors=torch.tensor([[1.0, 0.0, 0.0]]),
        ...     viewmats=torch.eye(4)[None],
        ...     Ks=torch.tensor([[[20.0, 0.0, 16.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]]]),
        ...     width=32,
        ...     height=24,
        ... )
        >>> image.shape, alpha.shape
        (torch.Size([1, 24, 32, 3]), torch.Size([1, 24, 32, 1]))
        >>> red, green, blue = image[0, 12, 16].tolist()
        >>> red > 0.9, green, blue
        (True, 0.0, 0.0)
        >>> image.sum().backward()
        >>> means.grad.shape
        torch.Size([1, 3])
    """
    refuse_unsupported(
        sparse_grad=sparse_grad,
        distributed=distributed,
        covars=covars is not None,
        with_ut=with_ut,
        with_eval3d=with_eval3d,
        radial_coeffs=radial_coeffs is not None,
        tangential_coeffs=tangential_coeffs is not None,
        thin_prism_coeffs=thin_prism_coeffs is not None,
        ftheta_coeffs=ftheta_coeffs is not None,
        viewmats_rs=viewmats_rs is not None,
        rolling_shutter=rolling_shutter is not None and getattr(rolling_shutter, "name", "GLOBAL") != "GLOBAL",
    )
    _check_modes(camera_model, render_mode, rasterize_mode)
    colors, shN = _bands(colors, sh_degree)
    near_plane, far_plane = planes(near_plane, far_plane)
    radius_clip, eps2d = as_float("radius_clip", radius_clip), as_float("eps2d", eps2d)
    width, height = as_int(width), as_int(height)
    check_tensors(means, quats, scales, opacities, colors, viewmats, Ks, sh_degree, shN, backgrounds, width, height)
    blended = (render_mode != "RGB") + ("RGB" in render_mode) * colors.shape[-1]
    # A pass over some channels knows only a part of each pixel's gradient. The absolute value needs the whole.
    if absgrad and blended > MAX_CHANNELS:
        raise NotImplementedError(
            f"The CPU rasterizer supports absgrad with at most {MAX_CHANNELS} channels, depth included, got {blended}; "
            "render the others without."
        )

    dtype, n_cameras, n = means.dtype, len(viewmats), len(means)
    given = means, quats, scales, opacities, colors, viewmats, Ks
    means, quats, scales, opacities, colors, viewmats, Ks = as_kernels_read(*given)
    if shN is not None:
        (shN,) = as_kernels_read(shN)
    antialiased = rasterize_mode == "antialiased"

    projected = [
        Project.apply(
            means, quats, scales, opacities, viewmat, K, width, height, near_plane, far_plane, eps2d, radius_clip,
            antialiased,
        )
        for viewmat, K in zip(_split(viewmats, None), _split(Ks, None), strict=True)
    ]  # fmt: skip
    *stacked, visible, block_starts = map(list, zip(*projected, strict=True))
    means2d, depths, conics, compensations, radii, sigmas = (_join(parts) for parts in stacked)
    # `expand` has an adjoint that sums, even over a single camera.
    opacities = opacities[None] if n_cameras == 1 else opacities.expand(n_cameras, n)
    if antialiased:
        opacities = opacities * compensations

    features = []
    if "RGB" in render_mode:
        features = _camera_colors(means, colors, shN, viewmats, visible, block_starts, sh_degree)

    camera_ids = gaussian_ids = counts = None
    if packed:
        counts = [len(rows) for rows in visible]
        camera_ids = torch.cat([torch.full((count,), camera, device="cpu") for camera, count in enumerate(counts)])
        gaussian_ids = torch.cat(visible).long()
        features = _pack(features, visible, block_starts) if features else []
        means2d, depths, conics, opacities, radii, sigmas = (
            # `unbind` has an adjoint that copies.
            _join(_pack([t.squeeze(0)] if n_cameras == 1 else t.unbind(), visible, block_starts))
            for t in (means2d, depths, conics, opacities, radii, sigmas)
        )
        visible, block_starts = map(list, zip(*map(all_rows, counts), strict=True))
    absolute = None
    if absgrad:
        absolute = torch.zeros_like(means2d)
        means2d.absgrad = absolute  # type: ignore[attr-defined]

    absolutes = None if absolute is None else _split(absolute, counts)
    projections = zip(*(_split(t, counts) for t in (means2d, conics, opacities, depths, sigmas)), strict=True)
    rendered = [
        _render_camera(
            projection,
            visible[camera],
            block_starts[camera],
            features[camera] if features else None,
            None if absolutes is None else absolutes[camera],
            None if backgrounds is None else backgrounds[camera],
            width,
            height,
            render_mode,
        )
        for camera, projection in enumerate(projections)
    ]
    images, alphas, tiles_per_gauss = zip(*rendered, strict=True)
    tile_width, tile_height = tiles(width, height)
    info = {
        "batch_ids": None if camera_ids is None else torch.zeros_like(camera_ids),
        "camera_ids": camera_ids,
        "gaussian_ids": gaussian_ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": _join(tiles_per_gauss if packed else [t.unsqueeze(0) for t in tiles_per_gauss]),
        "width": width,
        "height": height,
        "tile_size": TILE,
        "n_batches": 1,
        "n_cameras": n_cameras,
    }
    return _join(images).to(dtype), _join(alphas).to(dtype), info


def _check_modes(camera_model: str, render_mode: RenderMode, rasterize_mode: RasterizeMode) -> None:
    """Refuse a mode that does not exist or is not supported; raises as `rasterization` documents."""
    if camera_model != "pinhole":
        raise NotImplementedError(f"The CPU rasterizer only knows camera_model='pinhole', not {camera_model!r}.")
    if render_mode not in get_args(RenderMode):
        raise ValueError(f"render_mode must be RGB, D, ED, RGB+D or RGB+ED, not {render_mode!r}.")
    if rasterize_mode not in get_args(RasterizeMode):
        raise ValueError(f"rasterize_mode must be 'classic' or 'antialiased', not {rasterize_mode!r}.")


def _bands(colors: Tensor | tuple[Tensor, Tensor], sh_degree: int | None) -> tuple[Tensor, Tensor | None]:
    """Return colours in one tensor and None, or the constant band and the higher bands if they are a pair.

    Raises:
        ValueError: `colors` is a tuple but not a pair of bands.
    """
    if not isinstance(colors, tuple):
        return colors, None
    if sh_degree is None or len(colors) != 2:
        raise ValueError("colors as a tuple must be a pair (sh0 [N, 1, 3], shN [N, K - 1, 3]) with sh_degree set.")
    return colors


def _camera_colors(
    means: Tensor,  # [N, 3]
    colors: Tensor,  # [(C,) N, D], [(C,) N, K, 3], or [N, 1, 3] with `shN`
    shN: Tensor | None,  # [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    visible: Sequence[Tensor],
    block_starts: Sequence[Tensor],
    sh_degree: int | None,
) -> list[Tensor]:
    """Return the colours [N, D] of the Gaussians as each of the C cameras sees them."""
    shared = colors.dim() == (2 if sh_degree is None else 3)
    of_cameras = [colors if shared else colors[camera] for camera in range(len(viewmats))]
    if sh_degree is None:
        return of_cameras
    return [
        SphericalHarmonics.apply(
            means, camera_centre(viewmats[camera]), of_camera, shN, visible[camera], block_starts[camera], sh_degree
        )
        for camera, of_camera in enumerate(of_cameras)
    ]


def _pack(of_cameras: Sequence[Tensor], visible: list[Tensor], block_starts: list[Tensor]) -> list[Tensor]:
    """Return the visible rows [M, ...] of each camera's tensor [N, ...]."""
    return [Pack.apply(*rows) for rows in zip(of_cameras, visible, block_starts, strict=True)]


def _render_camera(
    projection: tuple[Tensor, ...],  # means2d, conics, opacities, depths and sigmas of R rows
    visible: Tensor,  # [M]
    block_start: Tensor,  # [ceil(R / BLOCK_ROWS) + 1]
    features: Tensor | None,  # [R, D]; None if only depth is rendered
    absolute: Tensor | None,  # [R, 2]
    background: Tensor | None,  # [D]
    width: int,
    height: int,
    render_mode: RenderMode,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render projected Gaussians. Returns image [1, H, W, X], alpha [1, H, W, 1] and tiles_per_gauss [R]."""
    means2d, conics, opacities, depths, sigmas = projection
    with_depth = render_mode != "RGB"
    channels = [] if features is None else [features]
    if with_depth:
        channels.append(depths.reshape(-1, 1))
    image, alpha, tiles_per_gauss = Blend.apply(
        means2d, conics, opacities, torch.cat(channels, 1) if len(channels) > 1 else channels[0],
        depths, sigmas, visible, block_start, width, height, absolute,
    )  # fmt: skip
    if background is not None and features is not None:
        behind = background.to(torch.float32)
        if with_depth:
            behind = torch.cat([behind, behind.new_zeros(1)])
        image = image + (1.0 - alpha) * behind
    if render_mode.endswith("ED"):
        expected = image[..., -1:] / alpha.clamp(min=1e-10)
        image = expected if features is None else torch.cat([image[..., :-1], expected], -1)
    return image, alpha, tiles_per_gauss


# Training usually renders one camera. It needs neither copies nor views, whose gradients would be views too.
def _join(tensors: Sequence[Tensor]) -> Tensor:
    return tensors[0] if len(tensors) == 1 else torch.cat(list(tensors))


def _split(tensor: Tensor, counts: list[int] | None) -> Sequence[Tensor]:
    """Split into one tensor per camera: [C, N, ...] keeps its first dimension, packed rows have `counts` per camera."""
    if len(tensor if counts is None else counts) == 1:
        return [tensor]
    return tensor.split(1 if counts is None else counts)
