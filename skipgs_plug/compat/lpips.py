"""Stand-in for `lpips` where its network cannot be had."""

from __future__ import annotations

import warnings
from typing import Any

import torch
from torch import Tensor


class AbsentLpips(torch.nn.Module):
    """LPIPS where its network cannot be had: a warning when first asked, and nan for a value."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__()

    def forward(self, image: Tensor, target: Tensor) -> Tensor:
        """Not a number. Shapes are not checked."""
        warnings.warn("LPIPS needs torchvision, which cannot be imported: reporting nan.", stacklevel=2)
        return torch.tensor(torch.nan)


LPIPS = AbsentLpips  # its name in the package
