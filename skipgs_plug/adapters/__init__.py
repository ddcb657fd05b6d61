"""One small file per trainer, and what one needs to write another: see `AbstractAdapter`."""

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import register_adapter
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import TrainerInfo

__all__ = ["AbstractAdapter", "Hooks", "TrainerInfo", "register_adapter"]
