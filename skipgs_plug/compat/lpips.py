"""Stand-in for `lpips` and `lpipsPyTorch` if their network is not available.

Some trainers evaluate before they save, so an error in the last iteration would lose the run.
"""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor


class AbsentLpips(torch.nn.Module):
    """LPIPS without its network: it warns and returns NaN."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """Warn, and return NaN. Shapes are not checked."""
        warnings.warn("LPIPS needs torchvision, which cannot be imported: reporting nan.", stacklevel=2)
        return torch.tensor(torch.nan)


LPIPS = AbsentLpips  # the class's name in the package `lpips`


def lpips(x: Tensor, y: Tensor, net_type: str = "alex", version: str = "0.1") -> Tensor:
    """Warn, and return NaN, in place of the function of `lpipsPyTorch`. Shapes are not checked."""
    return AbsentLpips()(x, y)  # type: ignore[no-any-return]
