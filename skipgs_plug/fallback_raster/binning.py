"""Which Gaussians touch which tile, front to back.

Gaussians are sorted by depth once (N keys instead of one key per tile pair) and then counted into tiles in that
order, so every tile's list comes out sorted and equal depths keep the order of the input. A tile is listed only
where the ellipse at alpha = 1/255 really crosses it (exact bounds per row of tiles, `kernels/ellipse.h`).
"""

from dataclasses import dataclass
from typing import Annotated

import torch
from torch import Tensor

from .constants import MAX_CHANNELS, RECORD, tiles
from .launch import FloatArray, IntArray, LongArray, floats, get_num_threads, ints, worker, zeros
from .shortcuts import active_shortcuts
from .source import read_kernel

# What 32-bit places in a list of pairs can count.
MAX_PAIRS = 2**31 - 1


# One core sorts while the others pack.
@worker(read_kernel("sort_and_pack.h"), items="1 + (n + BLOCK - 1) / BLOCK", grain="1")
def sort_and_pack(
    depths: Annotated[FloatArray, "R"],
    visible: Annotated[IntArray, "n"],
    keys: Annotated[IntArray, "2 * n"],  # scratch
    values: Annotated[IntArray, "2 * n"],  # out, the rows front to back in its second half
    means2d: Annotated[FloatArray, "R, 2"],
    conics: Annotated[FloatArray, "R, 3"],
    opacities: Annotated[FloatArray, "R"],
    sigmas: Annotated[FloatArray, "R, 2"],
    colors: Annotated[FloatArray, "R, stride"],
    records: Annotated[FloatArray, "R, RECORD"],  # out, only visible rows are written
    n: int,
    stride: int,
    channels: int,
) -> None: ...


@worker(read_kernel("pack_colors.h"), items="n", grain="BLOCK")
def pack_colors(
    visible: Annotated[IntArray, "n"],
    colors: Annotated[FloatArray, "R, stride"],
    records: Annotated[FloatArray, "R, RECORD"],  # the channels are replaced
    n: int,
    stride: int,
    channel: int,
    channels: int,
) -> None: ...


@worker(read_kernel("count_pairs.h"), items="slices", grain="1")
def count_pairs(
    order: Annotated[IntArray, "n"],
    records: Annotated[FloatArray, "R, RECORD"],
    counts: Annotated[IntArray, "slices, tiles_x, tiles_y"],  # out
    tiles_per_gauss: Annotated[IntArray, "R"],  # out, zeros before
    n: int,
    slices: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
    shortcuts: int,
) -> None: ...


@worker(read_kernel("scan_pairs.h"), items="1", grain="1")
def scan_pairs(
    counts: Annotated[IntArray, "slices, tiles"],  # in: counts; out: where each slice starts in each tile's list
    tile_start: Annotated[IntArray, "tiles + 1"],  # out
    tiles_per_gauss: Annotated[IntArray, "rows"],
    pair_start: Annotated[IntArray, "rows + 1"],  # out, running sum
    total: Annotated[LongArray, "1"],  # out, number of pairs
    rows: int,
    slices: int,
    tiles: int,
) -> None: ...


@worker(read_kernel("fill_pairs.h"), items="slices", grain="1")
def fill_pairs(
    order: Annotated[IntArray, "n"],
    records: Annotated[FloatArray, "R, RECORD"],
    counts: Annotated[IntArray, "slices, tiles_x, tiles_y"],  # next free place
    pair_start: Annotated[IntArray, "R + 1"],
    tile_list: Annotated[IntArray, "P"],  # out, rows
    pair_slot: Annotated[IntArray, "P"],  # out, for each Gaussian its places in tile_list
    n: int,
    slices: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
    shortcuts: int,
) -> None: ...


@dataclass
class Bins:
    """Tile lists of one image.

    Attributes:
        visible: [M] int32, rows of the visible Gaussians.
        records: [R, RECORD] float32, what the blend reads of each of them.
        tile_start: [tiles + 1] int32, begin of each tile's part of `tile_list`, row-major.
        tile_list: [P] int32, rows, front to back in every tile.
        pair_start: [R + 1] int32, begin of each row's part of `pair_slot`.
        pair_slot: [P] int32, places in `tile_list`.
        tiles_per_gauss: [R] int32, number of tiles of every row.
    """

    visible: Tensor
    records: Tensor
    tile_start: Tensor
    tile_list: Tensor
    pair_start: Tensor
    pair_slot: Tensor
    tiles_per_gauss: Tensor


def bin_gaussians(
    visible: Tensor,  # [M] int32
    means2d: Tensor,  # [R, 2]
    depths: Tensor,  # [R]
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    sigmas: Tensor,  # [R, 2]
    colors: Tensor,  # [R, D]
    width: int,
    height: int,
) -> Bins:
    """Sorts the visible Gaussians of one image by depth and lists them per tile, with their first channels.

    Raises:
        ValueError: There are more (tile, Gaussian) pairs than can be listed.
    """
    n = visible.numel()
    tiles_x, tiles_y = tiles(width, height)
    rows, channels = colors.shape
    keys, values = ints(2, 2 * n)
    records = floats(rows, RECORD)
    sort_and_pack(
        depths, visible, keys, values, means2d, conics, opacities, sigmas, colors, records,
        n, channels, min(channels, MAX_CHANNELS),
    )  # fmt: skip
    order = values[n:]

    # Any number of slices gives the same lists; one per thread keeps all busy.
    slices = 1 if n < 1024 else get_num_threads()
    counts = ints(slices, tiles_x * tiles_y)
    tile_start, pair_start = ints(tiles_x * tiles_y + 1), ints(rows + 1)
    tiles_per_gauss, total = zeros(rows, dtype=torch.int32), zeros(1, dtype=torch.int64)
    image = (float(width), float(height), tiles_x, tiles_y, active_shortcuts())
    count_pairs(order, records, counts, tiles_per_gauss, n, slices, *image)
    scan_pairs(counts, tile_start, tiles_per_gauss, pair_start, total, rows, slices, tiles_x * tiles_y)
    pairs = int(total)
    if pairs > MAX_PAIRS:
        raise ValueError(
            f"{n:,} visible Gaussians cover {pairs:,} tiles of an image of {width}x{height} pixels in all, and at most "
            f"{MAX_PAIRS:,} can be listed: render a smaller image, or fewer or smaller Gaussians."
        )
    tile_list, pair_slot = ints(pairs), ints(pairs)
    fill_pairs(order, records, counts, pair_start, tile_list, pair_slot, n, slices, *image)
    return Bins(visible, records, tile_start, tile_list, pair_start, pair_slot, tiles_per_gauss)
