"""Tile lists in two passes: first only as deep as pixels probably need, then the rest in tiles that need more.

Most of a large scene lies behind its surface, and no pixel needs those parts of the lists. A sample of the rows
predicts how deep the lists of each tile have to be (`kernels/near_ranges.h`). If a pixel of a tile is not finished at
the end of its list, the other pairs of the tile are listed and blended in a second pass. So the prediction only decides
about time: images are equal to the bit for any prediction.
"""

from typing import Annotated

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints
from ..runtime.constants import DEPTH_RANGE_INTS, NO_DEPTH
from ..runtime.launch import worker
from ..runtime.optimizations import OPTIMIZATIONS, active_optimizations
from ..runtime.parameters import FloatOutput, IntArray
from .binning import Bins, bin_gaussians
from .rows import visible_rows
from .structs import BLOCKS, BlockRows, DepthRangeOutput, Grid, RowList, Splats, grid

# Visible Gaussians per tile of the image below which everything is listed in one pass: sampling would cost more time
# than it saves.
MIN_ROWS_PER_TILE = 128
# Share of the sampled rows in the first lists above which everything is listed in one pass: a second pass would cost
# more time than it saves.
MAX_NEAR_SHARE = 0.7

# Tiles along each side of a cell, over which the light that Gaussians take is averaged. With 1, 2, 4, 8 and 16, forward
# over 1,000,000 random Gaussians at 504x378 takes 59, 49, 40 to 43, 37 to 40 and 36 ms, but there depth is the same
# everywhere. On 138,766 points of garden, 4, 8 and 16 are equal within the spread of repeated measurements.
CELL_TILES = 4
# Layers of equal ranges of depth bits in a cell. With 16, 32, 64 and 128, forward over these random Gaussians takes 45,
# 45, 42 to 43 and 43 ms.
CELL_LAYERS = 64
_SAMPLING = {
    "CELL_TILES": CELL_TILES,
    "CELL_LAYERS": CELL_LAYERS,
    # Rows that are sampled at least, if there are as many visible ones.
    "MIN_SAMPLED_ROWS": 16384,
    # Optical depth at which the first lists of a cell end: the light that Gaussians in front take, in units of the
    # light of its pixels. A pixel is finished at 9.2 on average, -ln(TRANSMITTANCE_MIN). Of 768 tiles of a scene, 20
    # left 14 to 28 to the second pass, and 16 left 98 to 119.
    "NEAR_OPTICAL_DEPTH": 20.0,
}


@worker(file="near_ranges.h", items="1", grain="1", constants=_SAMPLING)
def _near_ranges(
    *,
    visible: Annotated[IntArray, "m"],
    splats: Splats,
    # Scratch.
    taken: Annotated[FloatOutput, "-(-grid.tiles_x // CELL_TILES) * -(-grid.tiles_y // CELL_TILES), CELL_LAYERS"],
    ranges: Annotated[DepthRangeOutput, "grid.tiles_x * grid.tiles_y, DEPTH_RANGE_INTS"],
    share: Annotated[FloatOutput, "1"],  # of the sampled rows that lie in the ranges
    grid: Grid,
    m: int,
    n: int,
) -> None: ...


@worker(file="list_open.h", items=BLOCKS, grain="1")
def _list_open(
    *,
    visible: RowList,
    splats: Splats,
    open_before: Annotated[IntArray, "grid.tiles_y + 1, grid.tiles_x + 1"],
    found: BlockRows,
    grid: Grid,
    n: int,
    least: int,  # smallest depth, as bits, that was left out in an open tile
) -> None: ...


def near_ranges(
    visible: Tensor,  # [M]
    splats: Splats,  # R rows
    width: int,
    height: int,
) -> Tensor | None:
    """Return the depths [tiles, DEPTH_RANGE_INTS] that the first lists hold. None if a single pass is faster."""
    tiling = grid(width, height)
    tiles = tiling.tiles_x * tiling.tiles_y
    wanted = OPTIMIZATIONS["two_pass"] | OPTIMIZATIONS["saturation"]
    if active_optimizations() & wanted != wanted or len(visible) < MIN_ROWS_PER_TILE * tiles:
        return None
    cells = -(-tiling.tiles_x // CELL_TILES) * -(-tiling.tiles_y // CELL_TILES)
    ranges, share = ints(tiles, DEPTH_RANGE_INTS), floats(1)
    _near_ranges(
        visible=visible,
        splats=splats,
        taken=floats(cells, CELL_LAYERS),
        ranges=ranges,
        share=share,
        grid=tiling,
        m=len(visible),
        n=splats.depths.numel(),
    )
    return ranges if share.item() < MAX_NEAR_SHARE else None


def bin_behind(
    near: Bins,
    ranges: Tensor,  # [tiles, DEPTH_RANGE_INTS] of the first lists
    still_open: Tensor,  # [tiles], not zero where a pixel is not finished
    block_start: Tensor,  # [blocks + 1]
    splats: Splats,  # R rows, as for `bin_gaussians`
    colors: Tensor,  # [R, D]
) -> tuple[Bins, Tensor] | None:
    """List the Gaussians behind the first lists in tiles that are still open.

    Returns:
        The lists, and the start of each block of rows [blocks + 1] in them. None if no Gaussian is left.
    """
    tiling = near.grid
    _, ends = ranges.unbind(1)
    is_open = (still_open != 0) & (ends < NO_DEPTH)
    if not bool(is_open.any()):
        return None
    firsts = torch.where(is_open, ends, NO_DEPTH)
    behind = torch.stack([firsts, torch.full_like(firsts, NO_DEPTH)], 1)
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
        least=int(firsts.min()),
    )
    rows, starts = visible_rows(found)
    if len(rows) == 0:
        return None
    before = len(near.tile_record)
    return bin_gaussians(rows, splats, colors, tiling.width, tiling.height, False, behind, before), starts
