"""SkipGS backward gating for 3D Gaussian Splatting trainers, and a CPU rasterizer to try it without a GPU."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from skipgs_plug.adapters import register_adapter
    from skipgs_plug.core.config import SkipConfig
    from skipgs_plug.core.decision import Decision
    from skipgs_plug.core.errors import AdapterMismatchError, GateOrderError, SkipGSError, UnknownTrainerError
    from skipgs_plug.gate import SkipGate

__all__ = [
    "AdapterMismatchError",
    "Decision",
    "GateOrderError",
    "SkipConfig",
    "SkipGSError",
    "SkipGate",
    "UnknownTrainerError",
    "register_adapter",
]

# Loaded on first use: torch takes seconds to load, and the command must answer Ctrl-C and name missing packages before.
_HOMES = {
    "AdapterMismatchError": "core.errors",
    "Decision": "core.decision",
    "GateOrderError": "core.errors",
    "SkipConfig": "core.config",
    "SkipGSError": "core.errors",
    "SkipGate": "gate",
    "UnknownTrainerError": "core.errors",
    "register_adapter": "adapters",
}


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
