"""Densification by gsplat's MCMCStrategy: a fixed number of Gaussians that move to where they are needed."""

from __future__ import annotations

import contextlib

import torch
from torch import nn

from skipgs_plug.trainer.config import TrainConfig
from skipgs_plug.trainer.strategy import gsplat_class

# Iterations between moves, at least. MCMC averages no gradients over views, so it can do with less than the default
# strategy's 100.
MIN_MOVE_EVERY = 25


class Mcmc:
    """MCMC in units of the scene: the same scene at twice the size trains in the same way.

    Checkpoints need no state of it: its random numbers are a function of seed and iteration.

    Attributes:
        refine_start_iter: first iteration of the moves, exclusive, as all three in iterations of this run.
        refine_stop_iter: end of the moves, exclusive.
        refine_every: iterations from one to the next.
    """

    def __init__(self, config: TrainConfig, scene_scale: float) -> None:
        self.refine_stop_iter = config.scaled(config.recipe.refine_stop_iter)
        self.refine_every = config.scaled_interval(config.refine_every, MIN_MOVE_EVERY)
        self.refine_start_iter = config.scaled(config.refine_start_iter)
        self._strategy = gsplat_class("MCMCStrategy")(
            cap_max=config.cap_max,
            # It multiplies noise by covariances and by the rate of positions, which follows the scale of the scene.
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
        """Move and add if it is time to, and noise positions in proportion to `rate`, their learning rate."""
        on_cpu = splats["means"].device.type == "cpu"
        with _strategy_on_cpu() if on_cpu else contextlib.nullcontext():
            self._strategy.step_post_backward(splats, optimizers, self._constants, step, {}, lr=rate)


def _strategy_on_cpu() -> contextlib.AbstractContextManager[None]:
    from skipgs_plug.compat.strategy_operations import strategy_on_cpu

    return strategy_on_cpu()
