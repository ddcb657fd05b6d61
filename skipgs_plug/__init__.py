"""SkipGS backward gating for 3D Gaussian Splatting trainers, and a CPU rasterizer to try it without a GPU."""

from __future__ import annotations

from typing import TYPE_CHECKING

from skipgs_plug.lazy import attach

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

__getattr__, __dir__ = attach(__name__, _HOMES)
