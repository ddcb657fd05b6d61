"""The differentiable render call behind every stand-in, with the conventions of the Inria CUDA modules.

The CUDA modules take transposed matrices and tangents of half the field of view. They return channels-first images, and
write the gradient of the 2D means, in normalised device coordinates, to a dummy tensor `means2D`. This module
translates between these conventions and `rasterization`, which has gsplat's signature.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.runtime.function_modes import without_function_modes

from .pairs import squared_gradients
from .statistics import Footprint

# Gaussians nearer than this are culled, world units: `in_frustum` of the CUDA code.
NEAR_PLANE = 0.2
# Added to the diagonal of the 2D covariance, square pixels: the low-pass filter of the CUDA code.
EPS2D = 0.3


def backend() -> Any:
    """Return the rasterizer, which has gsplat's signature. Imported on first use, because Warp loads slowly."""
    from skipgs_plug.fallback_raster import rasterization

    return rasterization


class Splats(NamedTuple):
    """The differentiable inputs of one call. Exactly one of `shs` and `colors` is set."""

    means3D: Tensor  # [N, 3]
    means2D: Tensor  # [N, 3], or [N, 4] for absolute gradients in columns 2 and 3; its values are ignored
    opacities: Tensor  # [N, 1]
    scales: Tensor  # [N, 3]
    rotations: Tensor  # [N, 4] quaternions w, x, y, z
    dc: Tensor | None = None  # [N, 1, 3] degree 0, if separate from the higher degrees
    shs: Tensor | None = None  # [N, K, 3]
    colors: Tensor | None = None  # [N, 3]
    scores: Tensor | None = None  # [N, 1], receives sums of squared gradients (Speedy-Splat)


def splats(
    means3D: Tensor,
    means2D: Tensor,
    opacities: Tensor,
    dc: Tensor | None = None,
    shs: Tensor | None = None,
    colors_precomp: Tensor | None = None,
    scales: Tensor | None = None,
    rotations: Tensor | None = None,
    cov3D_precomp: Tensor | None = None,
    scores: Tensor | None = None,
) -> Splats:
    """Check the arguments of a `GaussianRasterizer` call, and drop empty ones.

    Raises:
        ValueError: Both or neither of `shs` and `colors_precomp` are given.
        NotImplementedError: 3D covariances are given in place of scales and rotations.
    """
    optional = (dc, shs, colors_precomp, scales, rotations, cov3D_precomp)
    dc, shs, colors, scales, rotations, covariances = (None if t is None or not len(t) else t for t in optional)
    if (shs is None) == (colors is None):
        raise ValueError("Give the rasterizer either shs or colors_precomp.")
    if covariances is not None or scales is None or rotations is None:
        raise NotImplementedError(
            "The CPU stand-in needs scales and rotations: run without --compute_cov3D_python, or with CUDA."
        )
    return Splats(means3D, means2D, opacities, scales, rotations, dc, shs, colors, scores)


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in gsplat's convention, made from the settings of an Inria-style call."""

    viewmat: Tensor  # [4, 4] world to camera
    K: Tensor  # [3, 3] pixels
    width: int
    height: int

    @classmethod
    def from_settings(cls, settings: Any) -> Camera:
        """Read `viewmatrix`, `projmatrix` (both transposed), `tanfovx/y` and the image size."""
        width, height = int(settings.image_width), int(settings.image_height)
        view = settings.viewmatrix.detach()
        # ndc = (P00 x + P02 z) / z: `projmatrix` without the view transform contains the principal point.
        projection = torch.linalg.solve(view.double(), settings.projmatrix.detach().double())
        K = torch.eye(3)
        K[0, 0], K[1, 1] = width / (2 * settings.tanfovx), height / (2 * settings.tanfovy)
        K[0, 2], K[1, 2] = (projection[2, 0] + 1) * width / 2, (projection[2, 1] + 1) * height / 2
        return cls(view.T.contiguous(), K.to(view), width, height)


class Rendering(NamedTuple):
    """Results of a call, from which each stand-in returns some."""

    color: Tensor  # [3, H, W]
    radii: Tensor  # [N] int32, pixels: 3 standard deviations; 0 if the Gaussian is not drawn
    footprint: Footprint  # the projected Gaussians, for per-Gaussian statistics
    inverse_depth: Tensor | None  # [1, H, W]


@without_function_modes
def render(
    settings: Any,
    gaussians: Splats,
    antialiased: bool = False,
    inverse_depth: bool = False,
    eps2d: float = EPS2D,
    absgrad: bool = False,
) -> Rendering:
    """Render Gaussians, differentiable in every member of `Splats`.

    Args:
        settings: A `GaussianRasterizationSettings` of any of the families.
        gaussians: The scene.
        antialiased: Compensate opacities for the low-pass filter.
        inverse_depth: Also blend 1 / depth.
        eps2d: Added to the 2D covariance, square pixels.
        absgrad: Add the sum of both absolute gradients to column 2 of the gradient of `means2D`. If `means2D` has four
            columns, columns 2 and 3 receive one absolute gradient each in any case.

    Returns:
        Image, radii, projected Gaussians, and inverse depth if requested.
    """
    call = _Call(settings, Camera.from_settings(settings), antialiased, inverse_depth, eps2d, absgrad)
    if torch.is_grad_enabled():
        color, inverse = _Render.apply(call, *gaussians)
    else:
        color, inverse = call.run(gaussians)
    return Rendering(color, call.radii, call.footprint, inverse)


class _Call:
    """One forward pass, with the state that the backward pass and the statistics need."""

    def __init__(
        self, settings: Any, camera: Camera, antialiased: bool, inverse_depth: bool, eps2d: float, absgrad: bool
    ) -> None:
        self.settings, self.camera = settings, camera
        self.mode = "antialiased" if antialiased else "classic"
        self.inverse_depth = inverse_depth
        self.eps2d, self.absgrad = eps2d, absgrad
        self.means2d: list[Tensor] = []  # one per pass over the Gaussians
        self.radii: Tensor
        self.footprint: Footprint

    def run(self, g: Splats) -> tuple[Tensor, Tensor | None]:
        colors: Tensor | None
        degree: int | None
        if g.shs is not None:
            colors = g.shs if g.dc is None else torch.cat([g.dc, g.shs], dim=1)
            degree = int(self.settings.sh_degree)
        else:
            colors, degree = g.colors, None
        color, info = self._pass(g, colors, degree, self.settings.bg.detach()[None])
        conics, drawn = info["conics"][0].detach(), (info["radii"][0] > 0).all(dim=-1)
        self.radii = _radii(conics, drawn)
        self.footprint = Footprint(
            means2d=info["means2d"][0].detach(),
            conics=conics,
            opacities=info["opacities"][0].detach(),
            depths=info["depths"][0].detach(),
            drawn=drawn,
            width=self.camera.width,
            height=self.camera.height,
        )
        if not self.inverse_depth:
            return color, None
        depth = g.means3D @ self.camera.viewmat[2, :3] + self.camera.viewmat[2, 3]
        inverse = 1.0 / depth.clamp_min(NEAR_PLANE)
        # Three equal channels, because rasterizers are optimized for three.
        inverse, _ = self._pass(g, inverse[:, None].expand(-1, 3), None, None)
        return color, inverse[:1]

    def _pass(self, g: Splats, colors: Any, degree: int | None, background: Any) -> tuple[Tensor, dict]:
        image, _, info = backend()(
            means=g.means3D,
            quats=g.rotations,
            scales=g.scales * self.settings.scale_modifier,
            opacities=g.opacities[:, 0],
            colors=colors,
            viewmats=self.camera.viewmat[None],
            Ks=self.camera.K[None],
            width=self.camera.width,
            height=self.camera.height,
            near_plane=NEAR_PLANE,
            eps2d=self.eps2d,
            sh_degree=degree,
            packed=False,
            backgrounds=background,
            absgrad=self.absgrad or g.means2D.shape[1] == 4,
            rasterize_mode=self.mode,
        )
        self.means2d.append(info["means2d"])
        return image[0].permute(2, 0, 1), info


class _Render(torch.autograd.Function):
    """Runs the call on detached leaves and differentiates it explicitly, which gives access to the 2D means."""

    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: Tensor | None) -> tuple[Tensor, Tensor | None]:
        ctx.set_materialize_grads(False)
        needed = ctx.needs_input_grad[1:]
        leaves = [t if t is None else t.detach().requires_grad_(n) for t, n in zip(tensors, needed, strict=True)]
        with torch.enable_grad():
            color, inverse = call.run(Splats(*leaves))  # type: ignore[arg-type]
        ctx.call, ctx.leaves, ctx.outputs = call, leaves, (color, inverse)
        return color.detach().clone(), None if inverse is None else inverse.detach().clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        call, leaves = ctx.call, Splats(*ctx.leaves)
        used = [(out, grad) for out, grad in zip(ctx.outputs, grads, strict=True) if grad is not None]
        found: list[Tensor | None] = [None] * len(leaves)
        wanted = [
            i
            for i, leaf in enumerate(leaves)
            if leaf is not None and leaf.requires_grad and Splats._fields[i] not in ("means2D", "scores")
        ]
        on_screen = [means2d for means2d in call.means2d if means2d.requires_grad]
        if used and wanted:
            inputs = [leaves[i] for i in wanted] + on_screen
            outputs, sent = zip(*used, strict=True)
            values = torch.autograd.grad(outputs, inputs, sent, allow_unused=True)
            for i, value in zip(wanted, values, strict=False):
                found[i] = value
            if leaves.means2D.requires_grad:
                found[1] = _screen_gradient(call, leaves.means2D, on_screen, values[len(wanted) :])
        if leaves.scores is not None and leaves.scores.requires_grad and grads[0] is not None:
            scores = squared_gradients(call.footprint, _rgb(call, leaves), call.settings.bg, grads[0])
            found[-1] = scores.reshape(leaves.scores.shape)
        return None, *found


def _screen_gradient(call: _Call, means2D: Tensor, on_screen: list[Tensor], values: Any) -> Tensor:
    """Return gradients of the 2D means in normalised device coordinates, in the columns of `means2D`."""
    half = means2D.new_tensor([call.camera.width / 2, call.camera.height / 2])
    gradient = torch.zeros_like(means2D)
    for means2d, value in zip(on_screen, values, strict=True):
        if value is None:
            continue
        gradient[:, :2] += value[0] * half
        if means2D.shape[1] == 4:
            gradient[:, 2:] += means2d.absgrad[0] * half  # type: ignore[attr-defined]
        elif call.absgrad:
            gradient[:, 2] += (means2d.absgrad[0] * half).sum(dim=1)  # type: ignore[attr-defined]
    return gradient


@torch.no_grad()
def _rgb(call: _Call, g: Splats) -> Tensor:
    """Return the colours that are blended. [N, 3]"""
    if g.colors is not None:
        return g.colors
    from skipgs_plug.fallback_raster import spherical_harmonics

    assert g.shs is not None
    coefficients = g.shs if g.dc is None else torch.cat([g.dc, g.shs], dim=1)
    directions = g.means3D - call.settings.campos
    return (spherical_harmonics(int(call.settings.sh_degree), directions, coefficients) + 0.5).clamp_min(0.0)


def _radii(conics: Tensor, drawn: Tensor) -> Tensor:
    """Return three standard deviations of the wider axis, rounded up as the CUDA code does. [N] int32"""
    a, b, c = conics.unbind(-1)
    # The eigenvalues of the covariance are the inverses of the conic's. The CUDA code's root has a floor of 0.1.
    determinant = torch.where(drawn, a * c - b * b, 1.0)
    middle = 0.5 * (a + c) / determinant
    widest = middle + (middle * middle - 1.0 / determinant).clamp_min(0.1).sqrt()
    return torch.where(drawn, (3.0 * widest.sqrt()).ceil(), 0.0).to(torch.int32)
