"""One small file per trainer, and what one needs to write another: see `AbstractAdapter`."""

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import register_adapter
from skipgs_plug.core.facts import TrainerFacts
from skipgs_plug.core.hooks import Hooks

__all__ = ["AbstractAdapter", "Hooks", "TrainerFacts", "register_adapter"]
