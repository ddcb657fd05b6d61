"""The reference trainer: the 3DGS recipe over gsplat's strategy, on gsplat (CUDA) or Warp (CPU).

It knows nothing of the gate, which is attached to it like to any other trainer.
"""

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
