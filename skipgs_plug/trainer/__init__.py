"""The reference trainer: the 3DGS recipe over gsplat's strategy, on gsplat (CUDA) or Warp (CPU).

It knows nothing of the gate, which is attached to it like to any other trainer.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from skipgs_plug.lazy import attach

if TYPE_CHECKING:
    from skipgs_plug.trainer.config import TrainConfig
    from skipgs_plug.trainer.errors import InputError, MissingFileError
    from skipgs_plug.trainer.loaders import load_scene
    from skipgs_plug.trainer.loaders.packed import save_packed
    from skipgs_plug.trainer.loop import Trainer
    from skipgs_plug.trainer.scene import Scene, View

__all__ = [
    "InputError",
    "MissingFileError",
    "Scene",
    "TrainConfig",
    "Trainer",
    "View",
    "load_scene",
    "save_packed",
]

# Loaded on first use: settings and errors need no torch.
_HOMES = {
    "InputError": "errors",
    "MissingFileError": "errors",
    "Scene": "scene",
    "TrainConfig": "config",
    "Trainer": "loop",
    "View": "scene",
    "load_scene": "loaders",
    "save_packed": "loaders.packed",
}

__getattr__, __dir__ = attach(__name__, _HOMES)
