"""One small file per trainer, and the tools to write another one: see `AbstractAdapter`."""

import warnings
from typing import Any

from skipgs_plug.adapters.base import AbstractAdapter
from skipgs_plug.adapters.registry import register_adapter
from skipgs_plug.core.hooks import Hooks
from skipgs_plug.core.trainer_info import Densification, TrainerInfo

__all__ = ["AbstractAdapter", "Densification", "Hooks", "TrainerInfo", "register_adapter"]

_RENAMED = {"TrainerFacts": TrainerInfo}  # names of 0.1


def __getattr__(name: str) -> Any:
    if name not in _RENAMED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    now = _RENAMED[name]
    warnings.warn(f"{__name__}.{name} is called {now.__name__} now.", DeprecationWarning, stacklevel=2)
    return now
