"""Optimizer steps on accumulated gradients (`step_mode="adaptive_norm"`), with the authors' constants."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

REF_K = 16.0  # the "ref_k" trigger: accumulated norm of this many single gradients
MAX_ACCUMULATED = 64  # backwards after which a step is taken in any case
REFERENCE_DECAY = 0.9  # of the running means of a single gradient's norm


class StepAccumulator:
    """Says when the gradients accumulated since the last step are worth a step.

    The first backward after a step gives a sample of a single gradient. Trigger "snr" fires when
    |sum g|^2 >= 2 n E|g|^2: the accumulated signal has caught up with the noise of n gradients. Trigger
    "ref_k" fires when |sum g| >= 16 E|g|.
    """

    def __init__(self, trigger: str) -> None:
        self._trigger = trigger
        self._norm_mean: float | None = None
        self._square_mean: float | None = None
        self._stale = False
        self.visible: Any = None
        self.count = 0
        self.last_norm = 0.0

    def observe(self, norm: float) -> None:
        """Take in the norm of the accumulated gradients after a backward."""
        if self.count == 0:
            if self._norm_mean is None or self._square_mean is None:
                self._norm_mean, self._square_mean = norm, norm * norm
            else:
                keep, gain = REFERENCE_DECAY, 1.0 - REFERENCE_DECAY
                self._norm_mean = keep * self._norm_mean + gain * norm
                self._square_mean = keep * self._square_mean + gain * norm * norm
        self.count += 1
        self.last_norm = norm

    def due(self) -> bool:
        """Whether a step should be taken now."""
        if self.count == 0 or self._norm_mean is None or self._square_mean is None:
            return False
        if self.count >= MAX_ACCUMULATED:
            return True
        if self._trigger == "snr":
            return self.last_norm**2 >= 2.0 * self.count * self._square_mean
        reference = REF_K * self._norm_mean
        return reference > 0 and self.last_norm >= reference

    def reset(self) -> None:
        """Begin a new window: after a step, or when a structural change dropped the gradients."""
        self.count = 0
        self.last_norm = 0.0
        self._stale = True

    def see(self, mask: Any) -> Any:
        """Add a visibility mask to the window and return the union, which a sparse optimizer must step."""
        if self._stale or self.visible is None or getattr(self.visible, "shape", 0) != getattr(mask, "shape", 0):
            self.visible, self._stale = mask, False
        else:
            self.visible = self.visible | mask
        return self.visible

    def state_dict(self) -> dict[str, Any]:
        """What outlives a window. A checkpoint holds no gradients, so a resumed run begins a new window."""
        return {"norm_mean": self._norm_mean, "square_mean": self._square_mean}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._norm_mean, self._square_mean = state["norm_mean"], state["square_mean"]
        self.reset()

    def load_release_state(self, state: dict[str, Any]) -> None:
        """Continue from a state of the authors' controller (`state_version` 1)."""
        self._norm_mean, self._square_mean = state["single_scale_ema"], state.get("single_sq_ema")
        self.reset()


def parameters_of(optimizers: Iterable[torch.optim.Optimizer]) -> list[Tensor]:
    """All parameters that these optimizers step."""
    return [p for optimizer in optimizers for group in optimizer.param_groups for p in group["params"]]


def has_pending_gradient(optimizer: torch.optim.Optimizer) -> bool:
    """Whether some parameter of the optimizer has a gradient that no step has used yet."""
    return any(p.grad is not None for group in optimizer.param_groups for p in group["params"])


def gradient_norm(parameters: Iterable[Tensor]) -> float:
    """Norm of all gradients as one vector; 0 without any. One read on the host."""
    norms = [p.grad.detach().norm() for p in parameters if p.grad is not None]
    return float(torch.stack(norms).norm()) if norms else 0.0
