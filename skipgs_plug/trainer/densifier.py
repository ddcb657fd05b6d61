"""Densification in a run: gsplat's DefaultStrategy or MCMC, at its place in each iteration."""

from __future__ import annotations

import logging
from typing import Any

import torch
from torch import nn

from skipgs_plug.trainer.backend import Backend
from skipgs_plug.trainer.clear_views import ClearViews
from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.densification import densify
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.mcmc import Mcmc
from skipgs_plug.trainer.order import derive_seed
from skipgs_plug.trainer.row_order import sort_rows, sorts_rows
from skipgs_plug.trainer.seeded import seeded
from skipgs_plug.trainer.strategy import create_strategy, reset_opacity_if_missed

log = logging.getLogger(__name__)


class Densifier:
    """Adds, moves and removes Gaussians by the strategy of the settings.

    Args:
        config: Settings.
        scene_scale: Size of the scene.
        clear_views: Fades Gaussians around cameras before each event.
        backend: Applies missed updates before rows are read.
        splats: Parameters by name.
        optimizers: One optimizer per parameter, by the same names.

    Attributes:
        strategy: gsplat's DefaultStrategy, or None with `mcmc`.
        mcmc: MCMC, or None with `strategy`.
        state: Sums of the strategy.
    """

    def __init__(
        self,
        config: TrainConfig,
        scene_scale: float,
        clear_views: ClearViews,
        backend: Backend,
        splats: nn.ParameterDict,
        optimizers: dict[str, torch.optim.Optimizer],
    ) -> None:
        self._seed, self._prune_opa, self._backend = config.seed, config.prune_opa, backend
        self._splats, self._optimizers = splats, optimizers
        self._stop = config.scaled(config.recipe.refine_stop_iter)
        self.mcmc = Mcmc(config, scene_scale) if config.strategy == "mcmc" else None
        self._clear_views = clear_views
        count = len(splats["means"])
        if self.mcmc is not None and count > config.cap_max:
            log.warning(
                "The scene starts with %d Gaussians, more than cap_max=%d: MCMC adds none and removes none.",
                *(count, config.cap_max),
            )
        self.strategy: Any = None
        self.state: dict[str, Any] = {}
        if self.mcmc is None:
            self.strategy = create_strategy(config)
            self.strategy.check_sanity(splats, optimizers)
            self.state = self.strategy.initialize_state(scene_scale=scene_scale)

    def before_backward(self, step: int, info: dict[str, Any]) -> None:
        """Ask for the gradients that densification averages.

        Args:
            step: Number of the iteration.
            info: Dictionary of the rasterizer.
        """
        if self.strategy is not None and step < self._stop:
            self.strategy.step_pre_backward(self._splats, self._optimizers, self.state, step, info)

    def after_update(self, step: int, info: dict[str, Any], updated: bool) -> None:
        """Densify after the optimizer steps of an iteration, if it is time.

        Args:
            step: Number of the iteration.
            info: Dictionary of the rasterizer.
            updated: Whether positions were updated.

        Raises:
            InputError: No Gaussian would be left.
        """
        if self.mcmc is not None:
            self._move(self.mcmc, step, updated)
        # A gate may have left this iteration without gradients, which densification averages.
        elif step < self._stop and info["means2d"].grad is not None:
            self._densify(step, info)

    def _densify(self, step: int, info: dict[str, Any]) -> None:
        args = (self._splats, self._optimizers, self.state, step)
        if step % self.strategy.refine_every:
            self.strategy.step_post_backward(*args, info, packed=info["gaussian_ids"] is not None)
        else:
            self._backend.catch_up(self._optimizers)
            self._clear_views.fade(self._splats["means"], self._splats["opacities"])
            with seeded(derive_seed(self._seed, step), self._backend.device):
                densify(self.strategy, *args, info, in_order=sorts_rows(self.strategy, step))
            require_some(len(self._splats["means"]) > 0, step, "lower prune_opa or raise prune_scale3d")
        reset_opacity_if_missed(self.strategy, *args)

    def _move(self, mcmc: Mcmc, step: int, updated: bool) -> None:
        # The noise belongs to the update: without an update it is a random walk.
        moves = mcmc.moves(step)
        if moves:
            self._clear_views.fade(self._splats["means"], self._splats["opacities"])
            alive = self._splats["opacities"].detach().sigmoid() > self._prune_opa  # others move to them
            require_some(bool(alive.any()), step, "lower prune_opa")
            self._backend.release_memory()  # gsplat copies all rows
            self._backend.catch_up(self._optimizers)
        if updated or moves:
            rate = self._optimizers["means"].param_groups[0]["lr"] if updated else 0.0
            with seeded(derive_seed(self._seed, step), self._backend.device):
                mcmc.after_update(self._splats, self._optimizers, step, rate)
        if sorts_rows(mcmc, step):
            self._backend.catch_up(self._optimizers)
            sort_rows(self._splats, self._optimizers, self.state)


def require_some(left: bool, step: int, cure: str) -> None:
    """Raise InputError unless Gaussians are left after the densification in an iteration."""
    if not left:
        raise InputError(f"Densification in iteration {step} leaves no Gaussian; {cure}.")
