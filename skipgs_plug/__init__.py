"""SkipGS backward gating for 3D Gaussian Splatting trainers, and a CPU rasterizer to try it without a GPU."""

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
