"""Densification by gsplat's DefaultStrategy, with scaled milestones and with its documented opacity reset."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from skipgs_plug.fallback_raster import sum_norms
from skipgs_plug.install import install_command
from skipgs_plug.trainer.config import MIN_REFINE_EVERY, MIN_RESET_EVERY, TrainConfig
from skipgs_plug.trainer.errors import InputError


def create_strategy(config: TrainConfig) -> Any:
    """Return a gsplat DefaultStrategy for this config (pure torch, runs without CUDA)."""
    return _with_kernel(gsplat_class("DefaultStrategy"))(
        prune_opa=config.prune_opa,
        grow_grad2d=config.grow_grad2d,
        grow_scale3d=config.grow_scale3d,
        prune_scale3d=config.prune_scale3d,
        refine_start_iter=config.scaled(config.refine_start_iter),
        refine_stop_iter=config.scaled(config.recipe.refine_stop_iter),
        refine_every=config.scaled_interval(config.refine_every, MIN_REFINE_EVERY),
        reset_every=reset_interval(config),
        absgrad=config.absgrad,
    )


def _with_kernel(strategy: type[Any]) -> type[Any]:
    """Return the class with a kernel that adds up gradients on the CPU: torch takes five times as long."""

    class Strategy(strategy):  # type: ignore[misc]
        def _update_state(
            self, params: Any, state: dict[str, Any], info: dict[str, Any], packed: bool = False, **more: Any
        ) -> None:
            means2d: Any = info[self.key_for_gradient]
            norms, counts = state["grad2d"], state["count"]
            begun = norms is not None and counts is not None
            if more or not begun or not packed or not means2d.is_cpu or self.refine_scale2d_stop_iter > 0:
                super()._update_state(params, state, info, packed=packed, **more)
                return
            scale = 0.5 * info["width"] * info["n_cameras"], 0.5 * info["height"] * info["n_cameras"]
            gradient = means2d.absgrad if self.absgrad else means2d.grad
            sum_norms(info["gaussian_ids"].to(torch.int32), gradient, scale, norms, counts)

    return Strategy


def gsplat_class(name: str) -> Any:
    """Return a strategy of gsplat by its name.

    Raises:
        InputError: gsplat cannot be imported.
    """
    try:
        import gsplat
    except ImportError as error:
        raise InputError(
            f"Densification needs gsplat, which cannot be imported ({error}); run: {install_command()}."
        ) from error
    return getattr(gsplat, name)


def reset_interval(config: TrainConfig) -> int:
    """Return the iterations between opacity resets, so that the last one leaves time to recover.

    In a short run, the scaled interval can put a reset right before the end of densification. Refinement would then
    start from a transparent model. So resets are spread such that no reset falls into the last MIN_RESET_EVERY
    iterations of densification. The schedule of 30,000 iterations does not change, and neither does a shorter interval
    that the user chose.
    """
    stop = config.scaled(config.recipe.refine_stop_iter)
    every = config.scaled_interval(config.reset_every, MIN_RESET_EVERY)
    if every < MIN_RESET_EVERY:
        return every
    resets = max(stop - MIN_RESET_EVERY, 0) // every
    return max(every, -(-stop // (resets + 1)))


def resets_in(strategy: Any, step: int) -> bool:
    """Whether opacities are reset in an iteration of this trainer, by the strategy or by `reset_opacity_if_missed`."""
    return 0 < step < strategy.refine_stop_iter and step % strategy.reset_every == 0


def reset_opacity_if_missed(
    strategy: Any,
    splats: nn.ParameterDict,
    optimizers: dict[str, torch.optim.Optimizer],
    state: dict[str, Any],
    step: int,
) -> bool:
    """Reset opacities if a reset is due in this step and the strategy did not do it. Return whether it acted.

    gsplat 1.5.3 writes `step % reset_every == 0 & step > 0`, which Python reads as
    `step % reset_every == 0 and 0 > 0`, so its reset never happens. A strategy that did reset leaves no opacity above
    the reset value, so this does nothing with a repaired gsplat.
    """
    if not resets_in(strategy, step):
        return False
    value = 2.0 * strategy.prune_opa
    if not bool((torch.sigmoid(splats["opacities"]) > 1.001 * value).any()):
        return False
    from gsplat.strategy.ops import reset_opa

    reset_opa(params=splats, optimizers=optimizers, state=state, value=value)
    return True
