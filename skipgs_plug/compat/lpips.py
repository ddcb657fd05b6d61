"""Stand-in for `lpips` if its network is not available."""

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
