"""A small scene and a camera with the conventions of Inria's trainers, for tests of the stand-ins."""

import math
from typing import Any

import torch
from torch import Tensor

WIDTH, HEIGHT = 40, 28
TANFOVX, TANFOVY = 0.5, 0.35


def camera(shift_x: float = 0.0) -> dict[str, Any]:
    """Return the fields of the settings. `shift_x` moves the principal point by that share of half the width."""
    angle = 0.3
    view = torch.eye(4)
    view[0, 0] = view[2, 2] = math.cos(angle)
    view[0, 2], view[2, 0] = math.sin(angle), -math.sin(angle)
    view[:3, 3] = torch.tensor([0.1, -0.05, 0.2])
    near, far = 0.01, 100.0
    projection = torch.zeros(4, 4)
    projection[0, 0], projection[1, 1] = 1 / TANFOVX, 1 / TANFOVY
    projection[0, 2] = shift_x
    projection[2, 2], projection[2, 3] = far / (far - near), -far * near / (far - near)
    projection[3, 2] = 1.0
    return {
        "image_height": HEIGHT,
        "image_width": WIDTH,
        "tanfovx": TANFOVX,
        "tanfovy": TANFOVY,
        "bg": torch.tensor([0.2, 0.4, 0.6]),
        "scale_modifier": 1.0,
        "viewmatrix": view.T,
        "projmatrix": view.T @ projection.T,
        "sh_degree": 2,
        "campos": torch.linalg.inv(view)[:3, 3],
        "prefiltered": False,
        "debug": False,
    }


def intrinsics(shift_x: float = 0.0) -> Tensor:
    """Return the K of the same camera, computed independently of the stand-ins."""
    fx, fy = WIDTH / (2 * TANFOVX), HEIGHT / (2 * TANFOVY)
    return torch.tensor([[fx, 0, (1 + shift_x) * WIDTH / 2], [0, fy, HEIGHT / 2], [0, 0, 1]])


def gaussians(n: int = 30, seed: int = 0) -> dict[str, Tensor]:
    """Return arguments of a `GaussianRasterizer` call, all of them leaves that require gradients."""
    rng = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    means = normal(n, 3) * torch.tensor([0.5, 0.35, 0.4]) + torch.tensor([-0.6, 0.0, 2.2])
    scene = {
        "means3D": means,
        "means2D": torch.zeros(n, 3),
        "opacities": torch.sigmoid(normal(n, 1)),
        "shs": 0.4 * normal(n, 9, 3),
        "scales": torch.exp(0.4 * normal(n, 3) - 2.6),
        "rotations": torch.nn.functional.normalize(normal(n, 4), dim=1),
    }
    return {name: value.requires_grad_() for name, value in scene.items()}


def oracle(
    scene: dict[str, Tensor], settings: dict[str, Any], K: Tensor, **options: Any
) -> tuple[Tensor, dict[str, Any]]:
    """Return the same image from the reference rasterizer in float64. [3, H, W]"""
    from skipgs_plug.fallback_raster.oracle.torch_reference import rasterization_reference

    image, _, info = rasterization_reference(
        scene["means3D"].double(),
        scene["rotations"].double(),
        scene["scales"].double() * settings["scale_modifier"],
        scene["opacities"].double()[:, 0],
        (options.pop("colors") if "colors" in options else scene["shs"]).double(),
        settings["viewmatrix"].T.double()[None],
        K.double()[None],
        WIDTH,
        HEIGHT,
        near_plane=0.2,
        sh_degree=options.pop("sh_degree", settings["sh_degree"]),
        packed=False,
        backgrounds=options.pop("backgrounds", settings["bg"][None]).double(),
        **options,
    )
    return image[0].permute(2, 0, 1), info
