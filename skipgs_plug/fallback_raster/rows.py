"""Lists of visible rows: the rows [M] of one image, and where each block of rows begins among them."""

from typing import Annotated

import torch
from torch import Tensor

from .buffers import floats, ints
from .constants import BLOCK, blocks
from .launch import FloatArray, IntArray, worker
from .project import list_visible
from .source import read_kernel


@worker(read_kernel("take_rows.h"), items="n", grain="4096")
def _take_rows(
    rows: Annotated[IntArray, "n"],
    source: Annotated[FloatArray, "R, 2"],
    taken: Annotated[FloatArray, "n, 2"],  # out
    n: int,
) -> None: ...


def take_rows(
    source: Tensor,  # [R, 2], numbers of 32 bits
    rows: Tensor,  # [M] int32
) -> Tensor:
    """`source[rows]`, on all cores; torch's takes as long as some kernels."""
    taken = floats(len(rows), 2)
    _take_rows(rows, source.view(torch.float32), taken, len(rows))
    return taken.view(source.dtype)


def visible_rows(seen: Tensor, block_count: Tensor) -> tuple[Tensor, Tensor]:
    """The rows that `project_forward` found visible."""
    visible, block_start = ints(len(seen)), ints(len(block_count) + 1)
    list_visible(seen, block_count, visible, block_start, len(block_count))
    return visible[: int(block_start[-1])], block_start


def all_rows(n: int) -> tuple[Tensor, Tensor]:
    """All of `n` rows."""
    starts = torch.arange(0, BLOCK * (blocks(n) + 1), BLOCK, dtype=torch.int32, device="cpu").clamp(max=n)
    return torch.arange(n, dtype=torch.int32, device="cpu"), starts
