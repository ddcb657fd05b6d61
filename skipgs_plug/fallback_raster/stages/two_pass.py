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
from ..runtime.launch import worker
from ..runtime.optimizations import OPTIMIZATIONS, active_optimizations
from ..runtime.parameters import FloatOutput, IntArray, IntOutput
from .binning import Bins, bin_gaussians
from .rows import visible_rows
from .structs import BlockRows, Grid, RowList, Splats, grid

# Visible Gaussians for each tile of the image, below which all are listed at once: sampling costs more than it saves.
ROWS_PER_TILE = 128
# Share of the rows in the first lists above which all are listed at once: a second pass would cost more than it saves.
WORTH = 0.7
# Bits of a depth beyond that of every Gaussian: the largest int, which no finite float has.
NO_DEPTH = 0x7FFFFFFF

# Tiles along the side of a cell, over which the light that Gaussians take is averaged.
CELL = 4
# Ranges of depth of a cell.
LAYERS = 64
_SAMPLING = {
    "CELL": CELL,
    "LAYERS": LAYERS,
    # Rows that are looked at, at least, where there are as many.
    "SAMPLES": 16384,
    # What one pixel has to lose before its list may end, in units of its light. It is finished at 9.2 on average,
    # -ln(TRANSMITTANCE_MIN).
    "ENOUGH": 20.0,
}


@worker(file="near_ranges.h", items="1", grain="1", constants=_SAMPLING)
def _near_ranges(
    *,
    visible: Annotated[IntArray, "m"],
    splats: Splats,
    taken: Annotated[FloatOutput, "-(-grid.tiles_x // CELL) * -(-grid.tiles_y // CELL), LAYERS"],  # scratch
    ranges: Annotated[IntOutput, "grid.tiles_x * grid.tiles_y, 2"],
    share: Annotated[FloatOutput, "1"],  # of the rows that the ranges hold
    grid: Grid,
    m: int,
    n: int,
) -> None: ...


@worker(file="list_open.h", items="(n + BLOCK - 1) / BLOCK", grain="1")
def _list_open(
    *,
    visible: RowList,
    splats: Splats,
    open_before: Annotated[IntArray, "grid.tiles_y + 1, grid.tiles_x + 1"],
    found: BlockRows,
    grid: Grid,
    n: int,
    least: int,  # of the depths that were left out in open tiles
) -> None: ...


def near_ranges(
    visible: Tensor,  # [M]
    splats: Splats,  # R rows
    width: int,
    height: int,
) -> Tensor | None:
    """Depths [tiles, 2] that the first lists hold; None if a single pass is faster."""
    tiling = grid(width, height)
    tiles = tiling.tiles_x * tiling.tiles_y
    wanted = OPTIMIZATIONS["two_pass"] | OPTIMIZATIONS["saturation"]
    if active_optimizations() & wanted != wanted or len(visible) < ROWS_PER_TILE * tiles:
        return None
    cells = -(-tiling.tiles_x // CELL) * -(-tiling.tiles_y // CELL)
    ranges, share = ints(tiles, 2), floats(1)
    _near_ranges(
        visible=visible,
        splats=splats,
        taken=floats(cells, LAYERS),
        ranges=ranges,
        share=share,
        grid=tiling,
        m=len(visible),
        n=splats.depths.numel(),
    )
    return ranges if share.item() < WORTH else None


def bin_behind(
    near: Bins,
    ranges: Tensor,  # [tiles, 2] of the first lists
    still_open: Tensor,  # [tiles], not zero where a pixel is not finished
    block_start: Tensor,  # [blocks + 1]
    splats: Splats,  # R rows, as for `bin_gaussians`
    colors: Tensor,  # [R, D]
) -> tuple[Bins, Tensor] | None:
    """Lists of Gaussians behind the first lists in tiles that are still open, and where blocks of rows begin in them.

    None if there are none.
    """
    tiling = near.grid
    is_open = (still_open != 0) & (ranges[:, 1] < NO_DEPTH)
    if not bool(is_open.any()):
        return None
    behind = torch.full_like(ranges, NO_DEPTH)
    behind[is_open, 0] = ranges[is_open, 1]
    open_before = torch.zeros(tiling.tiles_y + 1, tiling.tiles_x + 1, dtype=torch.int32, device="cpu")
    open_before[1:, 1:] = is_open.view(tiling.tiles_y, tiling.tiles_x).cumsum(0).cumsum(1)
    found = BlockRows(ints(len(colors)), ints(len(block_start) - 1))
    _list_open(
        visible=RowList(near.visible, block_start),
        splats=splats,
        open_before=open_before,
        found=found,
        grid=tiling,
        n=len(colors),
        least=int(behind[:, 0].min()),
    )
    rows, starts = visible_rows(found)
    if len(rows) == 0:
        return None
    before = len(near.tile_record)
    return bin_gaussians(rows, splats, colors, tiling.width, tiling.height, False, behind, before), starts
