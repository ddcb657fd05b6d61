"""Densification by gsplat's MCMCStrategy: a bounded number of Gaussians that move where they are needed."""

from __future__ import annotations

import contextlib

import torch
from torch import nn

from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.strategy import gsplat_class

# Iterations between moves, at least. MCMC averages no gradients over views, so it needs fewer than the default
# strategy's 100.
MIN_MOVE_EVERY = 25


class Mcmc:
    """MCMC in units of the scene, so that the same scene at twice the size trains in the same way.

    It has no state for checkpoints, since its random numbers are a function of seed and iteration.

    Attributes:
        refine_start_iter: Iteration of this run after which moves begin.
        refine_stop_iter: Iteration of this run before which moves end.
        refine_every: Iterations of this run between two moves.
    """

    def __init__(self, config: TrainConfig, scene_scale: float) -> None:
        self.refine_stop_iter = config.scaled(config.recipe.refine_stop_iter)
        self.refine_every = config.scaled_interval(config.refine_every, MIN_MOVE_EVERY)
        self.refine_start_iter = config.scaled(config.refine_start_iter)
        self._strategy = gsplat_class("MCMCStrategy")(
            cap_max=config.cap_max,
            # gsplat multiplies noise by covariances and by the rate of positions. Both grow with the scene.
            noise_lr=config.noise_lr / scene_scale**2,
            refine_start_iter=self.refine_start_iter,
            refine_stop_iter=self.refine_stop_iter,
            refine_every=self.refine_every,
            min_opacity=config.prune_opa,
        )
        self._constants = self._strategy.initialize_state()

    def moves(self, step: int) -> bool:
        """Whether dead Gaussians are moved, and new ones added, after iteration `step`."""
        return self.refine_start_iter < step < self.refine_stop_iter and step % self.refine_every == 0

    def after_update(
        self, splats: nn.ParameterDict, optimizers: dict[str, torch.optim.Optimizer], step: int, rate: float
    ) -> None:
        """Move and add Gaussians if it is time, and add noise to positions in proportion to their rate `rate`."""
        on_cpu = splats["means"].device.type == "cpu"
        with _strategy_on_cpu() if on_cpu else contextlib.nullcontext():
            self._strategy.step_post_backward(splats, optimizers, self._constants, step, {}, lr=rate)


def _strategy_on_cpu() -> contextlib.AbstractContextManager[None]:
    from skipgs_plug.compat.strategy_operations import strategy_on_cpu

    return strategy_on_cpu()
