"""Options of the gate, the same for every command that attaches one."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import tyro

from skipgs_plug.core.errors import SkipGSError


def shown(kind: str, default: str) -> Any:
    """How --help shows an option that may be left out, and what holds then."""
    return tyro.conf.arg(metavar=kind, help_behavior_hint=f"(default: {default})")


@dataclass
class GateOptions:
    """Settings of the gate, named as in SkipConfig; what is left out is the adapter's choice."""

    start_iter: Annotated[int | None, shown("INT", "end of densification")] = None
    """First iteration that may be skipped."""
    threshold: Annotated[float | None, shown("FLOAT", "0")] = None
    """Skip when loss <= mean * (1 + threshold)."""
    ema_decay: Annotated[float | None, shown("FLOAT", "0.95")] = None
    """Decay of each view's mean loss."""
    warmup: Annotated[int | None, shown("INT", "500; in train times max_steps / 30,000, at least 2 per view")] = None
    """Gated iterations without skipping."""
    min_bwd_ratio: Annotated[str | None, shown("SHARE|auto", "auto")] = None
    """Least share of gated iterations with a backward."""
    on_nonfinite: Annotated[Literal["skip", "raise", "pass"] | None, shown("skip|raise|pass", "skip")] = None
    """What a NaN or infinite loss does."""
    pause_iters: Annotated[int | None, shown("INT", "one round of the views, at least 500; scaled in train")] = None
    """Real backwards after a prune or reset."""
    step_mode: Annotated[Literal["off", "adaptive_norm"] | None, shown("off|adaptive_norm", "off")] = None
    """Accumulate gradients over several backwards before a step."""
    step_trigger: Annotated[Literal["snr", "ref_k"] | None, shown("snr|ref_k", "snr")] = None
    """When an accumulated step is taken."""

    refine_share: Annotated[str | None, shown("SHARE|auto", "the paper's gate, which leaves out none")] = None
    """Leave out whole iterations: the share of refinement that runs, such as 0.4, or auto."""
    tolerance: Annotated[float | None, shown("FLOAT", "0.05")] = None
    """Decibels that the rest of refinement may be worth when auto ends it."""
    compensate: Annotated[bool | None, shown("True|False", "with --refine-share only")] = None
    """Larger, shrinking steps for what is left out."""
    rate_peak: Annotated[float | None, shown("FLOAT", "by the share that runs and what views show")] = None
    """Factor on learning rates when refinement begins, falling to 0."""

    def given(self) -> dict[str, Any]:
        """The settings that the user gave, by name; what is no share is left for SkipConfig to refuse.

        Raises:
            SkipGSError: One of them does nothing without another, which is missing.
        """
        if self.refine_share is None:
            if self.tolerance is not None:
                raise SkipGSError("--tolerance is for --refine-share auto; give that too, or leave it out.")
            if self.rate_peak is not None and not self.compensate:
                raise SkipGSError(
                    "--rate-peak is for --refine-share or --compensate True; give one too, or leave it out."
                )
        settings = {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
        for name in ("min_bwd_ratio", "refine_share"):
            if name in settings:
                with contextlib.suppress(ValueError):
                    settings[name] = float(settings[name])
        return settings
