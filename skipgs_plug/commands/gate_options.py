"""Options of the gate, the same for every command that attaches one."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal


@dataclass
class GateOptions:
    """Settings of the gate, named as in SkipConfig; what is left out is the adapter's choice."""

    start_iter: int | None = None
    """First iteration that may be skipped; default: end of densification."""
    threshold: float | None = None
    """Skip when loss <= mean * (1 + threshold); default 0."""
    ema_decay: float | None = None
    """Decay of each view's mean loss; default 0.95."""
    warmup: int | None = None
    """Gated iterations without skipping; default 500; in `train` times max_steps / 30,000, at least 2 per view."""
    min_bwd_ratio: float | Literal["auto"] | None = None
    """Least share of gated iterations with a backward; default auto."""
    on_nonfinite: Literal["skip", "raise", "pass"] | None = None
    """What a NaN or infinite loss does; default skip."""
    pause_iters: int | None = None
    """Real backwards after a prune or reset; default: one round of the views, at least 500 (scaled in `train`)."""
    step_mode: Literal["off", "adaptive_norm"] | None = None
    """Accumulate gradients over several backwards before a step; default off."""
    step_trigger: Literal["snr", "ref_k"] | None = None
    """When an accumulated step is taken; default snr."""

    refine_share: float | Literal["auto"] | None = None
    """Leave out whole iterations: the share of refinement that runs (0.4), or auto; else the paper's gate."""
    tolerance: float | None = None
    """Decibels that the rest of refinement may be worth when auto ends it; default 0.05."""
    compensate: bool | None = None
    """Larger, shrinking steps for what is left out; default: with --refine-share only."""
    rate_peak: float | None = None
    """Factor on learning rates when refinement begins, falling to 0; default: by the share that runs and what views show."""

    def given(self) -> dict[str, Any]:
        """The settings that the user gave, by name."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
