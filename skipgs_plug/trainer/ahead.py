"""Prepare kernels while the scene of a training run is read."""

from __future__ import annotations

from skipgs_plug.trainer.backend import choose_backend
from skipgs_plug.trainer.config import TrainConfig


def prepare_kernels(config: TrainConfig) -> None:
    """Start to load or compile the kernels of a run with these settings. On a GPU, do nothing."""
    if choose_backend(config.backend) != "warp":
        return
    from skipgs_plug.fallback_raster import load_kernels_ahead

    # The kernel that adds up gradients is used from the second iteration of densification on.
    densifies = config.strategy == "default" and config.scaled(config.recipe.refine_stop_iter) > 1
    load_kernels_ahead(absgrad=config.absgrad, lazy=not config.visible_adam, densify=densifies)
