"""What gsplat's densification strategies ask of a gate, in gsplat's own script and in nerfstudio."""

from __future__ import annotations

from typing import Any

from skipgs_plug.core.hooks import Hooks


def is_mcmc(strategy: Any) -> bool:
    """Whether the strategy moves Gaussians at random in every iteration, to the very end."""
    return hasattr(strategy, "noise_lr")


def gradients_read_until(strategy: Any) -> int | None:
    """First iteration whose gradients the strategy does not read; None when it reads none at all."""
    return None if strategy is None or is_mcmc(strategy) else int(strategy.refine_stop_iter)


def leave_out_noise(hooks: Hooks, strategy: Any, owner: Any) -> range:
    """Leave MCMC's noise out where the gradient step is left out: alone it is a random walk.

    Args:
        hooks: Hooks of the trainer.
        strategy: The strategy; nothing happens unless it is MCMC.
        owner: Where to replace `step_post_backward`: the strategy, or its class.

    Returns:
        Iterations that must not be skipped: relocation is in the same method as the noise. They matter only
        to a gate that is started before relocation ends.
    """
    if not is_mcmc(strategy):
        return range(0)
    hooks.suppress_on_skip(owner, "step_post_backward")
    return range(0, strategy.refine_stop_iter, strategy.refine_every)
