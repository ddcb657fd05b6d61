"""Renders the views of a scene, and compares the images with the photographs."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.exposure import Exposure
from skipgs_plug.trainer.mask import leave_out
from skipgs_plug.trainer.near_plane import far_plane
from skipgs_plug.trainer.order import derive_seed
from skipgs_plug.trainer.scene import Scene, View


class ViewRenderer:
    """Renders views with the present parameters, and computes the loss of training.

    Args:
        config: Settings.
        scene: The scene.
        backend: Rasterizes, and computes the loss of images.
        splats: Parameters of the Gaussians. Their rows may change between two images.
        optimizers: One optimizer per parameter.
        exposure: Colour correction of each photograph; None for none.
        near_plane: Near clipping plane, in the units of `scene.frame`.

    Raises:
        InputError: The backgrounds would be random, but the photographs have one of their own.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene: Scene,
        backend: Backend,
        splats: nn.ParameterDict,
        optimizers: dict[str, torch.optim.Optimizer],
        exposure: Exposure | None,
        near_plane: float,
    ) -> None:
        self._config, self._scene, self._backend = config, scene, backend
        self._splats, self._optimizers, self._exposure = splats, optimizers, exposure
        self._near_plane, self._far_plane = near_plane, far_plane(config, scene)
        self._recipe = config.recipe
        self._background: Tensor | None = None  # [3]; None for black, which needs no compositing
        if any(scene.background):
            if config.random_bkgd:  # the photographs do not change with it, so it becomes a part of the model
                raise InputError(
                    f"The photographs of {scene.name} have one colour behind the scene (transparency becomes white), "
                    "and random backgrounds would train that colour into the model; leave out --random-bkgd."
                )
            self._background = torch.tensor(scene.background, dtype=torch.float32, device=backend.device)

    def render(self, view: View, degree: int) -> Tensor:
        """Return the image [H, W, 3] float32 of a view, in [0, 1] up to overshoot.

        Args:
            view: Camera and size of the image. A training view gets its exposure.
            degree: SH degree.
        """
        image, _ = self._rasterize(view, degree, self._background)
        return self._exposed(image, view)

    def forward(self, view: View, degree: int, step: int, with_rows: bool) -> tuple[Tensor, Tensor, dict[str, Any]]:
        """Return the image [H, W, 3] of a view, its photograph [H, W, 3] uint8, and the rasterizer's info.

        Args:
            view: The view. Masked pixels are left out of both images.
            degree: SH degree.
            step: Number of the iteration, which decides about a random background.
            with_rows: See `Backend.render`.
        """
        background = self._background
        if self._config.random_bkgd:
            generator = torch.Generator().manual_seed(derive_seed(self._config.seed, step))
            background = torch.rand(3, generator=generator, dtype=torch.float32).to(self._backend.device)
        image, info = self._rasterize(view, degree, background, with_rows)
        return (*leave_out(self._exposed(image, view), self.target(view), view.mask), info)

    def target(self, view: View) -> Tensor:
        """Return the photograph [H, W, 3] uint8 of a view, on the device."""
        return view.image.to(self._backend.device)

    def loss(self, image: Tensor, target: Tensor) -> Tensor:
        """Return the scalar loss of an image [H, W, 3] against its photograph, with the terms of the recipe."""
        loss = self._backend.loss(image, target, self._config.ssim_lambda)
        if self._recipe.opacity_reg > 0.0:
            loss = loss + self._recipe.opacity_reg * torch.sigmoid(self._splats["opacities"]).mean()
        if self._recipe.scale_reg > 0.0:
            per_unit = self._recipe.scale_reg / self._scene.scene_scale
            loss = loss + per_unit * torch.exp(self._splats["scales"]).mean()
        return loss

    def _exposed(self, image: Tensor, view: View) -> Tensor:
        return image if self._exposure is None else self._exposure.apply(image, view.name)

    def _rasterize(
        self, view: View, degree: int, background: Tensor | None, with_rows: bool = False
    ) -> tuple[Tensor, dict[str, Any]]:
        return self._backend.render(
            self._splats,
            view.viewmat,
            view.K,
            background,
            antialiased=self._config.antialiased,
            with_rows=with_rows,
            width=view.width,
            height=view.height,
            sh_degree=degree,
            near_plane=self._near_plane,
            far_plane=self._far_plane,
            absgrad=self._config.absgrad,
            optimizers=self._optimizers,
        )
