"""What a training run needs besides its scene, prepared while that is read."""

from __future__ import annotations

from skipgs_plug.trainer.backend import choose_backend
from skipgs_plug.trainer.config import TrainConfig


def prepare_kernels(config: TrainConfig) -> None:
    """Begin to load, or compile, the kernels of a run with these settings; nothing where it renders on a GPU."""
    if choose_backend(config.backend) != "warp":
        return
    from skipgs_plug.fallback_raster import load_kernels_ahead

    # Gradients are summed up from the second iteration on that densifies.
    densifies = config.strategy == "default" and config.scaled(config.recipe.refine_stop_iter) > 1
    load_kernels_ahead(absgrad=config.absgrad, lazy=not config.visible_adam, densify=densifies)
