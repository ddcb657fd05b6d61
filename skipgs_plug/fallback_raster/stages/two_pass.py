"""Lists that go no deeper than what fills the pixels, and what is added where that was not deep enough.

Most of a large scene lies behind its surface, and no pixel needs those lists. A sample of the rows tells how deep the
lists of a tile have to be (`kernels/near_ranges.h`). Where some pixel of a tile is not finished at the end of its list,
the rest of its pairs is listed and blended in a second pass. The depth therefore decides about time alone: images are
equal to the bit for any.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints
from ..runtime.constants import tiles
from ..runtime.launch import FloatArray, IntArray, worker
from ..runtime.optimizations import OPTIMIZATIONS, active_optimizations
from ..runtime.source import read_kernel
from .binning import Bins, bin_gaussians
from .rows import visible_rows

ROWS_PER_TILE = 128  # visible Gaussians for each tile of the image, below which all are listed at once
WORTH = 0.7  # share of the rows in the first lists above which all are listed at once
NO_DEPTH = 0x7FFFFFFF  # beyond the bits of every float

_CELL = 4
_LAYERS = 64
_SAMPLING = {
    "CELL": _CELL,  # tiles along the side of a cell, over which light is averaged
    "LAYERS": _LAYERS,  # ranges of depth
    "SAMPLES": 16384,  # rows at least, where there are as many
    # What one pixel has to lose before its list may end, in units of its light: it is finished at 9.2 on average.
    "ENOUGH": 20.0,
}


@worker(read_kernel("near_ranges.h"), items="1", grain="1", constants=_SAMPLING)
def _near_ranges(
    visible: Annotated[IntArray, "n"],
    means2d: Annotated[FloatArray, "R, 2"],
    depths: Annotated[FloatArray, "R"],
    conics: Annotated[FloatArray, "R, 3"],
    opacities: Annotated[FloatArray, "R"],
    taken: Annotated[FloatArray, "cells, layers"],  # scratch
    ranges: Annotated[IntArray, "tiles_x * tiles_y, 2"],  # out
    share: Annotated[FloatArray, "1"],  # out, of the rows that the ranges hold
    n: int,
    cells: int,
    layers: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
) -> None: ...


@worker(read_kernel("list_open.h"), items="blocks", grain="1")
def _list_open(
    visible: Annotated[IntArray, "n"],
    block_start: Annotated[IntArray, "blocks + 1"],
    means2d: Annotated[FloatArray, "R, 2"],
    depths: Annotated[FloatArray, "R"],
    opacities: Annotated[FloatArray, "R"],
    sigmas: Annotated[FloatArray, "R, 2"],
    open_before: Annotated[IntArray, "tiles_y + 1, tiles_x + 1"],
    seen: Annotated[IntArray, "R"],  # out, rows from where their block begins
    block_count: Annotated[IntArray, "blocks"],  # out, their number in each block
    n: int,
    blocks: int,
    least: int,  # of the depths that were left out in open tiles
    tiles_x: int,
    tiles_y: int,
) -> None: ...


def near_ranges(
    visible: Tensor,  # [M]
    means2d: Tensor,  # [R, 2]
    depths: Tensor,  # [R]
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    width: int,
    height: int,
) -> Tensor | None:
    """Depths [tiles, 2] that the first lists hold; None where they had better hold all."""
    tiles_x, tiles_y = tiles(width, height)
    wanted = OPTIMIZATIONS["two_pass"] | OPTIMIZATIONS["saturation"]
    if active_optimizations() & wanted != wanted or len(visible) < ROWS_PER_TILE * tiles_x * tiles_y:
        return None
    cells = -(-tiles_x // _CELL) * -(-tiles_y // _CELL)
    ranges, share = ints(tiles_x * tiles_y, 2), floats(1)
    _near_ranges(
        visible, means2d, depths, conics, opacities, floats(cells, _LAYERS), ranges, share,
        len(visible), cells, _LAYERS, float(width), float(height), tiles_x, tiles_y,
    )  # fmt: skip
    return ranges if share.item() < WORTH else None


def bin_the_rest(
    near: Bins,
    ranges: Tensor,  # [tiles, 2] of the first lists
    still_open: Tensor,  # [tiles], not zero where a pixel is not finished
    block_start: Tensor,  # [blocks + 1]
    means2d: Tensor,  # [R, 2], as the next ones as for `bin_gaussians`
    depths: Tensor,
    conics: Tensor,
    opacities: Tensor,
    sigmas: Tensor,
    colors: Tensor,
    width: int,
    height: int,
) -> tuple[Bins, Tensor] | None:
    """Lists of what lies behind the first lists in tiles that are still open, and where blocks of rows begin in them.

    None where there is nothing.
    """
    tiles_x, tiles_y = tiles(width, height)
    is_open = (still_open != 0) & (ranges[:, 1] < NO_DEPTH)
    if not bool(is_open.any()):
        return None
    behind = torch.full_like(ranges, NO_DEPTH)
    behind[is_open, 0] = ranges[is_open, 1]
    open_before = torch.zeros(tiles_y + 1, tiles_x + 1, dtype=torch.int32, device="cpu")
    open_before[1:, 1:] = is_open.view(tiles_y, tiles_x).cumsum(0).cumsum(1)
    count = len(block_start) - 1
    seen, block_count = ints(len(colors)), ints(count)
    _list_open(
        near.visible, block_start, means2d, depths, opacities, sigmas, open_before, seen, block_count,
        len(near.visible), count, int(behind[:, 0].min()), tiles_x, tiles_y,
    )  # fmt: skip
    rows, starts = visible_rows(seen, block_count)
    if len(rows) == 0:
        return None
    rest = bin_gaussians(
        rows, means2d, depths, conics, opacities, sigmas, colors, width, height, False, behind, len(near.tile_list)
    )
    return rest, starts
