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

    def forward(self, *args: Any, **kwargs: Any) -> Tensor:
        """Warn, and return NaN. Trainers and the package pass different arguments besides the two images."""
        warnings.warn("LPIPS needs torchvision, which cannot be imported: reporting nan.", stacklevel=2)
        return torch.tensor(torch.nan)


LPIPS = AbsentLpips  # the class's name in the package `lpips`


def lpips(*args: Any, **kwargs: Any) -> Tensor:
    """Warn, and return NaN, in place of the function of `lpipsPyTorch`. Some forks give it a mask, too."""
    return AbsentLpips()(*args, **kwargs)  # type: ignore[no-any-return]
