"""Lists of visible rows: the rows [M] of one image, and where each block of rows begins among them."""

import torch
from torch import Tensor

from .constants import BLOCK, blocks
from .launch import ints
from .project import list_visible


def visible_rows(seen: Tensor, block_count: Tensor) -> tuple[Tensor, Tensor]:
    """The rows that `project_forward` found visible."""
    visible, block_start = ints(len(seen)), ints(len(block_count) + 1)
    list_visible(seen, block_count, visible, block_start, len(block_count))
    return visible[: int(block_start[-1])], block_start


def all_rows(n: int) -> tuple[Tensor, Tensor]:
    """All of `n` rows."""
    starts = torch.arange(0, BLOCK * (blocks(n) + 1), BLOCK, dtype=torch.int32, device="cpu").clamp(max=n)
    return torch.arange(n, dtype=torch.int32, device="cpu"), starts
