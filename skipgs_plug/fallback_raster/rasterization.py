"""`rasterization` with gsplat's signature, on the CPU."""

from collections.abc import Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from .autograd import Blend, Project, SphericalHarmonics
from .binning import TILE

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
    """Renders N Gaussians (Kerbl et al. 2023) into C pinhole cameras; arguments and results as in gsplat 1.5.

    Computes in float32 on all cores (see `set_num_threads`) and returns the dtype of `means`. The result, images
    and gradients, is bit-equal for any number of threads. Differentiable in means, quats, scales, opacities,
    colors, backgrounds and viewmats.

    Args:
        means: Centres in world space.
        quats: Rotations w, x, y, z of any length; zero stands for no rotation.
        scales: Standard deviations along the axes, world units.
        opacities: In [0, 1].
        colors: D channels per Gaussian (per camera if C is given), or K >= (sh_degree + 1)^2 SH coefficients. Not in
            gsplat: the constant band and the others as a pair of tensors, which spares joining them in every
            iteration.
        viewmats: World to camera, x right, y down, z forward.
        Ks: Intrinsics in pixels; pixel centres lie at +0.5.
        width: Image width in pixels.
        height: Image height in pixels.
        near_plane: Gaussians nearer than this are left out, world units.
        far_plane: Gaussians farther than this are left out, world units.
        radius_clip: Gaussians whose radii are all at or below this are left out, pixels.
        eps2d: Added to the 2D covariance's diagonal, square pixels.
        sh_degree: 0 to 3 to read `colors` as SH coefficients, None to read them as colours.
        packed: True: `info` holds one row per visible (camera, Gaussian) pair, as gsplat's packed mode.
        tile_size: Kept for gsplat's callers; tiles are 16 pixels wide whatever it says.
        backgrounds: Colour behind everything; black if None.
        render_mode: Colour, accumulated depth (D), expected depth (ED), or colour and depth.
        sparse_grad: Not supported.
        absgrad: Also add up |gradient| of the 2D means over pixels (AbsGS), in `info["means2d"].absgrad`.
        rasterize_mode: "antialiased" scales opacities by the area lost to `eps2d` (Mip-Splatting).
        channel_chunk: Kept for gsplat's callers; any number of channels works.
        distributed: Not supported, as every argument below; each raises when it is used.
        camera_model: Only "pinhole".
        segmented: Kept for gsplat's callers; has no effect.
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
        Colours [C, H, W, X], alphas [C, H, W, 1] and gsplat's dictionary: means2d (with a gradient after
        backward), radii, depths, conics, opacities, tiles_per_gauss, width, height, n_cameras, ...; not in it are
        isect_ids and flatten_ids.

    Raises:
        ValueError: A shape, dtype, device or mode does not fit, or a camera is not finite.
        NotImplementedError: An option is not supported on the CPU.
    """
    unsupported = {
        "sparse_grad": sparse_grad,
        "distributed": distributed,
        "covars": covars is not None,
        "with_ut": with_ut,
        "with_eval3d": with_eval3d,
        "radial_coeffs": radial_coeffs is not None,
        "tangential_coeffs": tangential_coeffs is not None,
        "thin_prism_coeffs": thin_prism_coeffs is not None,
        "ftheta_coeffs": ftheta_coeffs is not None,
        "viewmats_rs": viewmats_rs is not None,
        "rolling_shutter": rolling_shutter is not None and getattr(rolling_shutter, "name", "GLOBAL") != "GLOBAL",
    }
    for name, used in unsupported.items():
        if used:
            raise NotImplementedError(f"The CPU rasterizer does not support {name}; leave it at its default.")
    if camera_model != "pinhole":
        raise NotImplementedError(f"The CPU rasterizer only knows camera_model='pinhole', not {camera_model!r}.")
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise ValueError(f"render_mode must be RGB, D, ED, RGB+D or RGB+ED, not {render_mode!r}.")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"rasterize_mode must be 'classic' or 'antialiased', not {rasterize_mode!r}.")
    sh_rest = None
    if isinstance(colors, tuple):
        if sh_degree is None or len(colors) != 2:
            raise ValueError("colors as a tuple must be a pair (sh0 [N, 1, 3], shN [N, K - 1, 3]) with sh_degree set.")
        colors, sh_rest = colors
    _check_tensors(
        means, quats, scales, opacities, colors, viewmats, Ks, sh_degree, sh_rest, backgrounds, width, height
    )

    dtype, n_cameras, n = means.dtype, len(viewmats), len(means)
    means, quats, scales, opacities, colors, viewmats, Ks = (
        t.to(torch.float32).contiguous() for t in (means, quats, scales, opacities, colors, viewmats, Ks)
    )
    if sh_rest is not None:
        sh_rest = sh_rest.to(torch.float32).contiguous()
    antialiased = rasterize_mode == "antialiased"
    shared_colors = colors.dim() == (2 if sh_degree is None else 3)

    projected = [
        Project.apply(
            means, quats, scales, opacities, viewmat, K, width, height, near_plane, far_plane, eps2d, radius_clip,
            antialiased,
        )
        for viewmat, K in zip(viewmats, Ks, strict=True)
    ]  # fmt: skip
    *stacked, visible, block_starts = map(list, zip(*projected, strict=True))
    means2d, depths, conics, compensations, radii, sigmas = (_stack(parts) for parts in stacked)
    opacities = opacities.expand(n_cameras, n)
    if antialiased:
        opacities = opacities * compensations

    features = []
    if "RGB" in render_mode:
        for camera in range(n_cameras):
            of_camera = colors if shared_colors else colors[camera]
            if sh_degree is not None:
                centre = torch.linalg.inv(viewmats[camera])[:3, 3]
                of_camera = SphericalHarmonics.apply(
                    means, centre, of_camera, sh_rest, visible[camera], block_starts[camera], sh_degree
                )
            features.append(of_camera)
    with_depth = render_mode != "RGB"

    camera_ids = gaussian_ids = counts = None
    if packed:
        camera_ids, gaussian_ids = radii[..., 0].nonzero(as_tuple=True)
        features = [f[gaussian_ids[camera_ids == c]] for c, f in enumerate(features)]
        means2d, depths, conics, opacities, radii, sigmas = (
            t[camera_ids, gaussian_ids] for t in (means2d, depths, conics, opacities, radii, sigmas)
        )
        counts = torch.bincount(camera_ids, minlength=n_cameras).tolist()
        visible = [torch.arange(count, dtype=torch.int32) for count in counts]
    absolute = None
    if absgrad:
        absolute = torch.zeros_like(means2d)
        means2d.absgrad = absolute  # type: ignore[attr-defined]

    images, alphas, tiles_per_gauss = [], [], []
    absolutes = [None] * n_cameras if absolute is None else _unstack(absolute, counts)
    of_cameras = zip(*(_unstack(t, counts) for t in (means2d, conics, opacities, depths, sigmas)), strict=True)
    for camera, (centres, shapes, strengths, distances, extents) in enumerate(of_cameras):
        channels = [features[camera]] if features else []
        if with_depth:
            channels.append(distances.unsqueeze(1))
        image, transmittance, tiles = Blend.apply(
            centres, shapes, strengths, torch.cat(channels, 1) if len(channels) > 1 else channels[0],
            distances, extents, visible[camera], width, height, absolutes[camera],
        )  # fmt: skip
        alpha = (1.0 - transmittance).unsqueeze(-1)
        if backgrounds is not None and features:
            behind = backgrounds[camera].to(torch.float32)
            if with_depth:
                behind = torch.cat([behind, behind.new_zeros(1)])
            image = image + transmittance.unsqueeze(-1) * behind
        if render_mode.endswith("ED"):
            expected = image[..., -1:] / alpha.clamp(min=1e-10)
            image = torch.cat([image[..., :-1], expected], -1) if features else expected
        images.append(image)
        alphas.append(alpha)
        tiles_per_gauss.append(tiles)

    info = {
        "batch_ids": None if camera_ids is None else torch.zeros_like(camera_ids),
        "camera_ids": camera_ids,
        "gaussian_ids": gaussian_ids,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "tile_width": (width + TILE - 1) // TILE,
        "tile_height": (height + TILE - 1) // TILE,
        "tiles_per_gauss": torch.cat(tiles_per_gauss) if packed else _stack(tiles_per_gauss),
        "width": width,
        "height": height,
        "tile_size": TILE,
        "n_batches": 1,
        "n_cameras": n_cameras,
    }
    return _stack(images).to(dtype), _stack(alphas).to(dtype), info


# One camera is the rule in training: views, whose gradients are views too, spare copies of everything.
def _stack(tensors: Any) -> Tensor:
    return tensors[0].unsqueeze(0) if len(tensors) == 1 else torch.stack(list(tensors))


def _unstack(tensor: Tensor, counts: list[int] | None) -> Sequence[Tensor]:
    """One tensor per camera, of rows that are stacked, or packed with `counts` per camera."""
    if counts is not None:
        return [tensor] if len(counts) == 1 else tensor.split(counts)
    return [tensor.squeeze(0)] if len(tensor) == 1 else tensor.unbind()


def _check_tensors(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    sh_degree: int | None,
    sh_rest: Tensor | None,
    backgrounds: Tensor | None,
    width: int,
    height: int,
) -> None:
    tensors = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
        "viewmats": viewmats,
        "Ks": Ks,
    }
    if backgrounds is not None:
        tensors["backgrounds"] = backgrounds
    if sh_rest is not None:
        tensors["colors[1]"] = sh_rest
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor) or not tensor.is_floating_point():
            kind = tensor.dtype if isinstance(tensor, Tensor) else type(tensor).__name__
            raise ValueError(f"{name} must be a floating point tensor, got {kind}.")
        if tensor.device.type != "cpu":
            raise ValueError(f"{name} is on {tensor.device}, but this rasterizer runs on the CPU: use {name}.cpu().")
    if means.dim() != 2 or means.shape[1] != 3:
        raise ValueError(f"means must have shape [N, 3] (no batch dimensions), got {list(means.shape)}.")
    n = len(means)
    n_cameras = len(viewmats) if viewmats.dim() else 0
    expected = {
        "quats": [n, 4],
        "scales": [n, 3],
        "opacities": [n],
        "viewmats": [n_cameras, 4, 4],
        "Ks": [n_cameras, 3, 3],
    }
    for name, shape in expected.items():
        if list(tensors[name].shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {list(tensors[name].shape)}.")
    if n_cameras == 0:
        raise ValueError("viewmats must hold at least one camera, got none.")
    shape = list(colors.shape)
    if sh_degree is None:
        if shape[:-1] not in ([n], [n_cameras, n]) or shape[-1] == 0:
            raise ValueError(f"colors must have shape [{n}, D] or [{n_cameras}, {n}, D], got {shape}.")
        channels = shape[-1]
    else:
        if sh_degree not in (0, 1, 2, 3):
            raise ValueError(f"sh_degree must be 0 to 3 on the CPU, got {sh_degree!r}.")
        terms = (sh_degree + 1) ** 2
        if sh_rest is not None:
            rest = list(sh_rest.shape)
            if shape != [n, 1, 3] or len(rest) != 3 or rest[0] != n or rest[2] != 3:
                raise ValueError(
                    f"colors as a pair must have shapes [{n}, 1, 3], [{n}, K - 1, 3], got {shape}, {rest}."
                )
            shape = [n, 1 + rest[1], 3]
        if shape[-1:] != [3] or shape[:-2] not in ([n], [n_cameras, n]) or shape[-2] < terms:
            raise ValueError(
                f"colors must have shape [{n}, K, 3] or [{n_cameras}, {n}, K, 3] with K >= {terms} for "
                f"sh_degree={sh_degree}, got {shape}."
            )
        channels = 3
    if backgrounds is not None and list(backgrounds.shape) != [n_cameras, channels]:
        raise ValueError(f"backgrounds must have shape [{n_cameras}, {channels}], got {list(backgrounds.shape)}.")
    if not (isinstance(width, int) and isinstance(height, int) and width > 0 and height > 0):
        raise ValueError(f"width and height must be whole numbers of at least 1, got {width!r} and {height!r}.")
    for name in ("viewmats", "Ks"):
        if not torch.isfinite(tensors[name]).all():
            raise ValueError(f"{name} holds NaN or infinity: a camera must be finite.")
