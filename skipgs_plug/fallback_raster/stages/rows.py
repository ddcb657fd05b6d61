"""Lists of visible rows: the rows [M] of one image, and the start of each block of rows among them."""

import math
from typing import Annotated

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints
from ..runtime.constants import BLOCK_ROWS, blocks
from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray
from .project import list_visible
from .structs import BLOCKS, BlockRows, RowList


@worker(file="take_rows.h", items="n", grain="4096")
def _take_rows(
    *,
    rows: Annotated[IntArray, "n"],
    source: Annotated[FloatArray, "R, width"],
    taken: Annotated[FloatOutput, "n, width"],
    n: int,
    width: int,
) -> None: ...


@worker(file="put_rows.h", items=BLOCKS, grain="1")
def _put_rows(
    *,
    visible: RowList,
    packed: Annotated[FloatArray, "visible.block_start[-1], width"],
    put: Annotated[FloatOutput, "n, width"],
    n: int,
    width: int,
) -> None: ...


def take_rows(
    source: Tensor,  # [R, ...], numbers of 32 bits
    rows: Tensor,  # [M] int32
) -> Tensor:
    """Return `source[rows]`, computed on all cores: torch's indexing takes as long as some kernels.

    Args:
        source: Tensor [R, ...] on the CPU whose numbers have 32 bits. It is not differentiated.
        rows: Row numbers [M], int32, each from 0 to R - 1. They are not checked.

    Returns:
        The rows [M, ...], of the dtype of `source`.
    """
    shape = len(rows), *source.shape[1:]
    taken = floats(*shape)
    source_floats = source.contiguous().view(torch.float32)
    _take_rows(rows=rows, source=source_floats, taken=taken, n=len(rows), width=math.prod(shape[1:]))
    return taken.view(source.dtype)


def put_rows(
    packed: Tensor,  # [M, ...] float32
    n: int,
    visible: RowList,
) -> Tensor:
    """Return the adjoint of `take_rows`: `n` rows, zero except for the listed ones."""
    shape = n, *packed.shape[1:]
    put = floats(*shape)
    _put_rows(visible=visible, packed=packed.contiguous(), put=put, n=n, width=math.prod(shape[1:]))
    return put


def visible_rows(found: BlockRows) -> RowList:
    """Join the rows that a kernel found in each block to one list."""
    visible, block_start = ints(len(found.rows)), ints(len(found.counts) + 1)
    list_visible(
        found=found.rows,
        block_count=found.counts,
        visible=visible,
        block_start=block_start,
        blocks=len(found.counts),
    )
    return RowList(visible[: int(block_start[-1])], block_start)


def all_rows(n: int) -> RowList:
    """Return the list of all `n` rows."""
    starts = torch.arange(0, BLOCK_ROWS * (blocks(n) + 1), BLOCK_ROWS, dtype=torch.int32, device="cpu").clamp(max=n)
    return RowList(torch.arange(n, dtype=torch.int32, device="cpu"), starts)
