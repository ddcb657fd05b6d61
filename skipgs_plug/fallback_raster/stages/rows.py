"""Lists of visible rows: the rows [M] of one image, and where each block of rows begins among them."""

import math
from typing import Annotated

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints
from ..runtime.constants import BLOCK, blocks
from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.source import read_kernel
from .project import list_visible


@worker(read_kernel("take_rows.h"), items="n", grain="4096")
def _take_rows(
    rows: Annotated[IntArray, "n"],
    source: Annotated[FloatArray, "R, width"],
    taken: Annotated[FloatArray, "n, width"],  # out
    n: int,
    width: int,
) -> None: ...


@worker(read_kernel("put_rows.h"), items="(n + BLOCK - 1) / BLOCK", grain="1")
def _put_rows(
    rows: Annotated[IntArray, "M"],
    block_start: Annotated[IntArray, "blocks(n) + 1"],
    packed: Annotated[FloatArray, "M, width"],
    put: Annotated[FloatArray, "n, width"],  # out
    n: int,
    width: int,
) -> None: ...


def take_rows(
    source: Tensor,  # [R, ...], numbers of 32 bits
    rows: Tensor,  # [M] int32
) -> Tensor:
    """`source[rows]`, on all cores; torch's takes as long as some kernels."""
    shape = len(rows), *source.shape[1:]
    taken = floats(*shape)
    _take_rows(rows, source.contiguous().view(torch.float32), taken, len(rows), math.prod(shape[1:]))
    return taken.view(source.dtype)


def put_rows(
    packed: Tensor,  # [M, ...] float32
    n: int,
    rows: Tensor,  # [M] int32, ascending
    block_start: Tensor,  # [ceil(n / BLOCK) + 1], where each block of the `n` rows begins in `rows`
) -> Tensor:
    """The adjoint of `take_rows`: `n` rows, zeros but for `rows`."""
    shape = n, *packed.shape[1:]
    put = floats(*shape)
    _put_rows(rows, block_start, packed.contiguous(), put, n, math.prod(shape[1:]))
    return put


def visible_rows(seen: Tensor, block_count: Tensor) -> tuple[Tensor, Tensor]:
    """The rows that `project_forward` found visible."""
    visible, block_start = ints(len(seen)), ints(len(block_count) + 1)
    list_visible(seen, block_count, visible, block_start, len(block_count))
    return visible[: int(block_start[-1])], block_start


def all_rows(n: int) -> tuple[Tensor, Tensor]:
    """All of `n` rows."""
    starts = torch.arange(0, BLOCK * (blocks(n) + 1), BLOCK, dtype=torch.int32, device="cpu").clamp(max=n)
    return torch.arange(n, dtype=torch.int32, device="cpu"), starts
