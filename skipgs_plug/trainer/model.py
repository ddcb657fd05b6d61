"""The Gaussians: raw parameters from a point cloud, and one optimizer for each."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.near_plane import before_a_lens, far_plane, shows_a_point
from skipgs_plug.trainer.row_order import morton_order, take
from skipgs_plug.trainer.scene import Scene
from skipgs_plug.trainer.selective_adam import SelectiveAdam
from skipgs_plug.trainer.sh0 import sh0_of

log = logging.getLogger(__name__)

ADAM_EPS = 1e-15  # as in gsplat's and Inria's trainers: the root of a second moment can be far below torch's 1e-8


def create_splats(scene: Scene, config: TrainConfig, device: torch.device, near: float) -> nn.ParameterDict:
    """Return the Gaussians that training starts from: the scene's, or an isotropic Gaussian per point.

    They are `means [N, 3]`, `scales [N, 3]` (log), `quats [N, 4]` (wxyz), `opacities [N]` (logit), `sh0 [N, 1, 3]` and
    `shN [N, K - 1, 3]`, sorted so that neighbours in space are neighbours in memory. Points in front of a lens, nearer
    than the near plane `near`, are left out.

    Raises:
        InputError: All points are nearer than the near plane.
    """
    if scene.gaussians is not None:
        tensors = {name: tensor.clone() for name, tensor in scene.gaussians.items()}
        higher = torch.zeros(len(tensors["means"]), (config.sh_degree + 1) ** 2 - 1, 3, dtype=torch.float32)
        known = min(higher.shape[1], tensors["shN"].shape[1])
        higher[:, :known] = tensors["shN"][:, :known]
        tensors["shN"] = higher
    else:
        tensors = one_per_point(scene, config)
        wrong = before_a_lens(scene.train, scene.points, near)
        if bool(wrong.all()):
            raise InputError(
                f"All {len(wrong):,} points of {scene.name} are nearer than the near plane "
                f"{near * scene.frame.unit:g}; lower --near-plane or leave it out."
            )
        tensors = {name: tensor[~wrong] for name, tensor in tensors.items()}
    if not shows_a_point(scene.train, tensors["means"], near, far_plane(config, scene)):
        log.warning(
            "None of the %d training views of %s shows one of its %d points, so its pictures may stay empty; check "
            "that cameras and points have the same axes, unit and origin.",
            *(len(scene.train), scene.name, len(tensors["means"])),
        )
    order = morton_order(tensors["means"])
    return nn.ParameterDict({name: nn.Parameter(take(tensor, order).to(device)) for name, tensor in tensors.items()})


def one_per_point(scene: Scene, config: TrainConfig) -> dict[str, Tensor]:
    n = len(scene.points)
    rgb = scene.points_rgb.float() / 255.0
    distance = neighbour_distance(scene.points, scene.scene_scale)
    return {
        "means": scene.points.clone(),
        "scales": torch.log(distance * config.recipe.init_scale)[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float32).repeat(n, 1),
        "opacities": torch.logit(torch.full((n,), config.recipe.init_opa, dtype=torch.float32)),
        "sh0": sh0_of(rgb)[:, None, :],
        "shN": torch.zeros(n, (config.sh_degree + 1) ** 2 - 1, 3, dtype=torch.float32),
    }


def neighbour_distance(points: Tensor, scale: float) -> Tensor:
    """Return the root mean square distance to the three nearest other points [M]; 0.0003 of `scale` for duplicates."""
    from scipy.spatial import cKDTree

    distances, _ = cKDTree(points.numpy()).query(points.numpy(), k=4)  # column 0 is the point itself
    mean_square = np.mean(distances[:, 1:] ** 2, axis=1)
    least = 1e-7 * scale**2  # duplicates have distance 0
    return torch.from_numpy(np.sqrt(np.maximum(mean_square, least))).float()


def create_optimizers(
    splats: nn.ParameterDict, config: TrainConfig, scene_scale: float, backend: Backend
) -> dict[str, torch.optim.Optimizer]:
    """Return one Adam per parameter, with the learning rates of gsplat's simple_trainer."""
    rates = {
        "means": config.means_lr * scene_scale,
        "scales": config.scales_lr,
        "quats": config.quats_lr,
        "opacities": config.opacities_lr,
        "sh0": config.sh0_lr,
        "shN": config.shN_lr,
    }
    if config.visible_adam:
        return {
            name: SelectiveAdam([{"params": [splats[name]], "lr": rate, "name": name}], eps=ADAM_EPS)
            for name, rate in rates.items()
        }
    return {name: backend.create_adam(name, splats[name], rate, ADAM_EPS) for name, rate in rates.items()}


def step_optimizers(
    splats: nn.ParameterDict, optimizers: dict[str, torch.optim.Optimizer], visible_in: dict[str, Any] | None
) -> bool:
    """Step all optimizers and drop the gradients. Return whether positions had a gradient that is used now.

    Args:
        splats: Parameters by name.
        optimizers: One optimizer per parameter, by the same names.
        visible_in: Dictionary of the rasterizer, to update only the Gaussians that its image shows; None for all.
    """
    means = splats["means"]
    pending = means.grad is not None
    for optimizer in optimizers.values():
        if visible_in is None:
            optimizer.step()
        else:
            optimizer.step(_visible(visible_in, means))  # type: ignore[call-overload]
        optimizer.zero_grad(set_to_none=True)
    return pending and splats["means"].grad is None


def _visible(info: dict[str, Any], means: Tensor) -> Tensor:
    """Return which Gaussians an image shows [N]."""
    if info["gaussian_ids"] is None:
        return (info["radii"] > 0).all(dim=-1).any(dim=0)  # type: ignore[no-any-return]
    visible = torch.zeros(len(means), dtype=torch.bool, device=means.device)
    visible[info["gaussian_ids"]] = True
    return visible
