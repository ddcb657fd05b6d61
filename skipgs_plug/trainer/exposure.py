"""Exposure: an affine colour correction per photograph, for cameras that change exposure between frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

LR, LR_END = 0.01, 0.001  # first and last learning rate of Inria's 3DGS
MOMENTS = ("exp_avg", "exp_avg_sq")


class Exposure:
    """Learns a map from the model's colours to the colours of each training photograph.

    The mean of all corrections is kept at the identity, so the model has the mean colours of all photographs. Held-out
    views have no correction; see `fit_colours`.

    Attributes:
        affine: Matrix and offset on RGB in [0, 1], [V, 3, 4]. It starts as the identity.
        optimizer: Optimizer of `affine`.
    """

    def __init__(self, names: Sequence[str], device: torch.device) -> None:
        self._index = {name: i for i, name in enumerate(names)}
        self.affine = nn.Parameter(torch.eye(3, 4, device=device).repeat(len(names), 1, 1))
        self.optimizer = torch.optim.Adam([{"params": [self.affine], "lr": LR, "name": "exposure"}], fused=True)

    def set_learning_rate(self, progress: float) -> None:
        """Set the learning rate, which falls exponentially, for a point `progress` in [0, 1] of the schedule."""
        self.optimizer.param_groups[0]["lr"] = LR * (LR_END / LR) ** progress

    def apply(self, image: Tensor, name: str) -> Tensor:
        """Return a render [H, W, 3] in the colours of photograph `name`. An unknown name changes nothing."""
        if name not in self._index:
            return image
        affine = self.affine[self._index[name]]
        return image @ affine[:, :3].T + affine[:, 3]

    def step(self) -> None:
        """Update, unless a gate left this iteration without a gradient or postpones the update."""
        pending = self.affine.grad is not None
        self.optimizer.step()
        self.optimizer.zero_grad(set_to_none=True)
        if pending and self.affine.grad is None:
            with torch.no_grad():  # otherwise model and corrections drift together: on fern by 4 dB in 600 iterations
                self.affine.sub_(self.affine.mean(dim=0) - torch.eye(3, 4, device=self.affine.device))

    def state_dict(self) -> dict[str, Any]:
        return {"affine": self.affine.detach(), **self.optimizer.state.get(self.affine, {})}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a state.

        Raises:
            ValueError: The state is of other views, or holds NaN.
        """
        moments = [name for name in MOMENTS if name in state]
        for name in ("affine", *moments):
            if state[name].shape != self.affine.shape or not bool(torch.isfinite(state[name]).all()):
                raise ValueError(f"its exposure ({name}) does not fit {len(self._index)} views")
        with torch.no_grad():
            self.affine.copy_(state["affine"])
        self.optimizer.state.clear()
        if moments:
            device = self.affine.device
            own = {name: state[name].to(device, copy=True) for name in (*MOMENTS, "step")}
            self.optimizer.state[self.affine] = own


@torch.no_grad()
def fit_colours(image: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the image [H, W, 3] after the affine map of colours that brings it closest to the target.

    The map is a least-squares fit over the pixels of `mask` [H, W]. Evaluations of models with exposure usually do
    this, since the exposure of a held-out photograph is unknown.
    """
    source = torch.cat([image, torch.ones_like(image[..., :1])], dim=-1)  # [H, W, 4]
    known = (source.reshape(-1, 4), target.reshape(-1, 3))
    if mask is not None:
        known = (source[mask], target[mask])
    rows, wanted = (part.double() for part in known)
    # The ridge matters only for a picture of one colour, which many maps fit equally well.
    ridge = 1e-6 * len(rows) * torch.eye(4, dtype=torch.float64, device=rows.device)
    identity = torch.eye(4, 3, dtype=torch.float64, device=rows.device)
    solution = torch.linalg.solve(rows.T @ rows + ridge, rows.T @ wanted + ridge @ identity)
    return source @ solution.to(source.dtype)
