"""Options of the gate, the same for every command that attaches one."""

from __future__ import annotations

import contextlib
import dataclasses
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Optional

from skipgs_plug.commands.options.parse import OptionalIntegers, shown
from skipgs_plug.core.errors import SkipGSError


@dataclass
class GateOptions:
    """Settings of the gate, with the names of SkipConfig. The adapter chooses all settings that are not given."""

    start_iter: Annotated[Optional[int], shown("INT", "end of densification")] = None
    """First iteration that may be skipped."""
    threshold: Annotated[Optional[float], shown("FLOAT", "0")] = None
    """Skip when loss <= mean * (1 + threshold)."""
    ema_decay: Annotated[Optional[float], shown("FLOAT", "0.95")] = None
    """Decay of each view's mean loss."""
    warmup: Annotated[Optional[int], shown("INT", "500; in train times max_steps / 30,000, at least 2 per view")] = None
    """Gated iterations without skipping."""
    min_bwd_ratio: Annotated[Optional[str], shown("SHARE|auto", "auto")] = None
    """Smallest share of gated iterations with a backward pass."""
    on_nonfinite: Annotated[Optional[Literal["skip", "raise", "pass"]], shown("skip|raise|pass", "skip")] = None
    """How to treat a NaN or infinite loss."""
    pause_iters: Annotated[Optional[int], shown("INT", "one round of the views, at least 500; scaled in train")] = None
    """Iterations without skipping after a prune or reset."""

    share: Annotated[Optional[str], shown("SHARE|auto", "the paper's gate, which leaves out no iterations")] = None
    """Share of the run's iterations that run, such as 0.3, or auto. The others are left out."""
    grow_share: Annotated[Optional[str], shown("SHARE|auto", "as --share")] = None
    """The same, but only until densification ends. There are fewer densification events."""
    refine_share: Annotated[Optional[str], shown("SHARE|auto", "as --share")] = None
    """The same, but only after densification, such as 0.4, or auto."""
    half_size: Annotated[Optional[bool], shown("True|False", "with auto, if photographs lose little by it")] = None
    """Until densification ends, or the scene has grown strongly, train on photographs of half the width and height."""
    max_gaussians: Annotated[Optional[int], shown("INT", "no bound")] = None
    """With --share: largest number of Gaussians. Densification stops before an event could exceed it."""
    always: Annotated[OptionalIntegers, shown("INT ...", "none")] = None
    """Iterations that always run besides those that the loop's conditions name, for conditions that cannot be read."""
    tolerance: Annotated[Optional[float], shown("FLOAT", "0.05")] = None
    """With auto: refinement ends when the rest of it is worth less than this, in decibels."""
    compensate: Annotated[Optional[bool], shown("True|False", "True with --share or --refine-share")] = None
    """Make up for left-out iterations with larger, shrinking steps."""
    rate_peak: Annotated[Optional[float], shown("FLOAT", "by the shares that run and that a view shows")] = None
    """Factor on learning rates when refinement begins. It falls to 0."""

    def given(self) -> dict[str, Any]:
        """Return the settings that the user gave, by name. SkipConfig checks the values.

        Raises:
            SkipGSError: A setting needs another one, which is missing.
        """
        shares = (self.share, self.grow_share, self.refine_share)
        if all(share is None for share in shares):
            if self.tolerance is not None:
                raise SkipGSError(
                    "--tolerance is for --refine-share auto and --share auto; give one too, or leave it out."
                )
            if self.always is not None:
                raise SkipGSError("--always is for --share or --refine-share; give one too, or leave it out.")
            if self.rate_peak is not None and not self.compensate:
                raise SkipGSError(
                    "--rate-peak is for --share, --refine-share or --compensate True; give one too, or leave it out."
                )
        settings = {name: value for name, value in dataclasses.asdict(self).items() if value is not None}
        for name in ("min_bwd_ratio", "share", "grow_share", "refine_share"):
            if name in settings:
                with contextlib.suppress(ValueError):
                    settings[name] = float(settings[name])
        return settings
