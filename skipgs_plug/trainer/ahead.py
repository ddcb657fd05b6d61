"""Prepare kernels while the scene of a training run is read."""

from __future__ import annotations

from skipgs_plug.trainer.backend import resolve_backend
from skipgs_plug.trainer.config import TrainConfig


def prepare_kernels(config: TrainConfig) -> None:
    """Start to load or compile the kernels of a run with these settings. On a GPU, only check the backend.

    Raises:
        InputError: The backend cannot run here. It is said before the scene is read, which can take minutes.
    """
    if resolve_backend(config.backend).name != "warp":
        return
    from skipgs_plug.fallback_raster import load_kernels_ahead

    # The kernel that adds up gradients is used from the second iteration of densification on.
    densifies = config.strategy == "default" and config.scaled(config.recipe.refine_stop_iter) > 1
    load_kernels_ahead(absgrad=config.absgrad, lazy=not config.visible_adam, densify=densifies)
