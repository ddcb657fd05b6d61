"""Small scenes, and the comparison with the reference, for the rasterizer's tests."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from skipgs_plug.fallback_raster.oracle.torch_reference import near_cutoff, rasterization_reference

DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "backgrounds")


def look_at(eye: tuple[float, float, float]) -> Tensor:
    """Return the world-to-camera matrix [4, 4] of a camera at `eye` that looks at the origin, y down."""
    position = torch.tensor(eye, dtype=torch.float64)
    forward = -position / position.norm()
    right = torch.linalg.cross(torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64), forward)
    right = right / right.norm()
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward])
    matrix[:3, 3] = -matrix[:3, :3] @ position
    return matrix


def random_scene(
    n: int = 300,
    width: int = 44,
    height: int = 37,
    cameras: int = 1,
    sh_degree: int | None = None,
    channels: int = 3,
    backgrounds: bool = False,
    seed: int = 0,
) -> dict[str, Any]:
    """Return arguments of `rasterization` for a ball of Gaussians of many sizes, in float32."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    eyes = [(0.3, -0.4, -4.0), (2.5, 0.7, -3.0), (-1.0, 2.0, 3.5)][:cameras]
    focal = 0.9 * width
    scene: dict[str, Any] = {
        "means": 0.9 * normal(n, 3),
        "quats": normal(n, 4),
        "scales": 0.3 * torch.exp(-3.0 * uniform(n, 3)),
        "opacities": 0.02 + 0.93 * uniform(n),
        "colors": uniform(n, channels) if sh_degree is None else 0.4 * normal(n, (sh_degree + 1) ** 2, 3),
        "viewmats": torch.stack([look_at(eye) for eye in eyes]),
        "Ks": torch.tensor([[focal, 0, 0.47 * width], [0, 1.1 * focal, 0.55 * height], [0, 0, 1]]).expand(
            cameras, 3, 3
        ),
        "backgrounds": uniform(cameras, channels) if backgrounds else None,
    }
    scene = {name: t if t is None else t.float().contiguous() for name, t in scene.items()}
    return {**scene, "width": width, "height": height, "sh_degree": sh_degree}


def deep_scene(n: int, width: int = 70, height: int = 45, seed: int = 0, size: float = 1.0) -> dict[str, Any]:
    """Return many small opaque Gaussians behind one another, a few large ones, and a gap at one side."""
    generator = torch.Generator().manual_seed(seed)
    depth = 2 + 6 * torch.rand(n, generator=generator)
    x = (2 * torch.rand(n, generator=generator) - 1) * 0.6 * depth
    y = (2 * torch.rand(n, generator=generator) - 1) * 0.4 * depth
    x = torch.where(depth < 5, x.clamp(min=-0.2 * depth), x)  # near Gaussians leave the left of the image free
    scales = size * (0.06 * torch.rand(n, 3, generator=generator) + 0.03)
    scales[::211] *= 20
    return {
        "means": torch.stack([x, y, depth], dim=1),
        "scales": scales,
        "quats": torch.randn(n, 4, generator=generator),
        "opacities": 0.3 + 0.7 * torch.rand(n, generator=generator),
        "colors": torch.rand(n, 3, generator=generator),
        "viewmats": torch.eye(4)[None],
        "Ks": torch.tensor([[[0.9 * width, 0, width / 2], [0, 0.9 * width, height / 2], [0, 0, 1]]]),
        "width": width,
        "height": height,
    }


def leaves(scene: dict[str, Any], dtype: torch.dtype, extra: tuple[str, ...] = ()) -> dict[str, Any]:
    """Return the scene with new tensors of `dtype` that require gradients."""
    fresh = dict(scene)
    for name, value in scene.items():
        if torch.is_tensor(value):
            wanted = name in DIFFERENTIABLE + extra
            fresh[name] = value.detach().to(dtype, copy=True).requires_grad_(wanted)
    return fresh


def relative_error(value: Tensor, truth: Tensor) -> float:
    """Return the L2 distance relative to the truth's L2 norm, or the norm itself if the truth is zero."""
    difference = (value.double() - truth.double()).norm()
    return (difference / truth.double().norm()).item() if truth.any() else difference.item()


def errors_against_reference(
    rasterization: Any, scene: dict[str, Any], extra: tuple[str, ...] = (), **options: Any
) -> dict[str, float]:
    """Return errors of a float32 rendering and its gradients, compared with the float64 reference.

    Pixels near a cut-off are compared in neither: their upstream gradient is zero.

    Returns:
        Largest absolute errors of `image` and `alpha`; that of an image with values above 1 is a share of its largest
        value. For means2d and every differentiable argument, the relative L2 error of its gradient.
    """
    results = {}
    masked = torch.empty(0)
    for name, function, dtype in (
        ("reference", rasterization_reference, torch.float64),
        ("fast", rasterization, torch.float32),
    ):
        inputs = leaves(scene, dtype, extra)
        image, alpha, info = function(**inputs, **options)
        if name == "reference":
            masked = near_cutoff(info)[..., None]
            generator = torch.Generator().manual_seed(7)
            upstream, upstream_alpha = (
                torch.randn(t.shape, generator=generator, dtype=torch.float64).masked_fill(masked, 0)
                for t in (image, alpha)
            )
            assert masked.double().mean() < 0.1, "the scene has too many pixels at a cut-off to compare"
        info["means2d"].retain_grad()
        torch.autograd.backward([image, alpha], [upstream.to(dtype), upstream_alpha.to(dtype)])
        results[name] = inputs, image.detach(), alpha.detach(), info
    truth, fast = results["reference"], results["fast"]
    scale = max(1.0, truth[1].abs().max().item())
    errors = {
        "image": ((fast[1] - truth[1]).masked_fill(masked, 0).abs().max() / scale).item(),
        "alpha": (fast[2] - truth[2]).masked_fill(masked, 0).abs().max().item(),
        "means2d": relative_error(fast[3]["means2d"].grad, truth[3]["means2d"].grad),
    }
    if options.get("absgrad"):
        errors["absgrad"] = relative_error(fast[3]["means2d"].absgrad, truth[3]["means2d"].absgrad)
    for name in DIFFERENTIABLE + extra:
        value = truth[0][name]
        if value is not None and value.grad is not None:
            assert fast[0][name].grad is not None, f"no gradient reached {name}"
            errors[name] = relative_error(fast[0][name].grad, value.grad)
    return errors
