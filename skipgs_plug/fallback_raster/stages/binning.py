"""Which Gaussians touch which tile, front to back.

Rows are taken in their order twice, to count the pairs of each tile and to list them, and every tile then sorts its own
list, only as far as its pixels take it (`kernels/lib/sorted_tile.h`): behind the surface of a scene of a million
Gaussians most of a list is never looked at. Equal depths keep the order of the input. A tile is listed only where the
ellipse at alpha = 1/255 really crosses it (exact bounds per row of tiles, `kernels/lib/ellipse.h`).
"""

from dataclasses import dataclass
from typing import Annotated

from torch import Tensor

from ..runtime.buffers import floats, ints, longs
from ..runtime.constants import BOX, MAX_CHANNELS, PLACE, RECORD, SPARE_COUNTS, tiles
from ..runtime.launch import FloatArray, IntArray, LongArray, worker
from ..runtime.optimizations import active_optimizations
from ..runtime.source import read_kernel
from ..runtime.threads import get_num_threads

# What 32-bit places in a list of pairs can count.
MAX_PAIRS = 2**31 - 1

# Slices of the rows that each thread counts and lists.
SLICES = 4


@worker(read_kernel("pack_colors.h"), items="slices", grain="1")
def _pack_colors(
    visible: Annotated[IntArray, "n"],
    listed: Annotated[IntArray, "n"],
    listed_count: Annotated[IntArray, "slices"],
    colors: Annotated[FloatArray, "R, stride"],
    records: Annotated[FloatArray, "n, RECORD"],  # the channels are replaced
    n: int,
    slices: int,
    stride: int,
    channel: int,
    channels: int,
) -> None: ...


@worker(read_kernel("pack_and_count.h"), items="slices", grain="1")
def pack_and_count(
    visible: Annotated[IntArray, "n"],
    means2d: Annotated[FloatArray, "R, 2"],
    depths: Annotated[FloatArray, "R"],
    conics: Annotated[FloatArray, "R, 3"],
    opacities: Annotated[FloatArray, "R"],
    sigmas: Annotated[FloatArray, "R, 2"],
    colors: Annotated[FloatArray, "R, stride"],
    ranges: Annotated[IntArray, "tiles_x * tiles_y if limited else 0, 2"],
    records: Annotated[FloatArray, "n, RECORD"],  # out, of rows that have pairs, from where their slice begins
    listed: Annotated[IntArray, "n"],  # out, places in `visible` of those
    listed_count: Annotated[IntArray, "slices"],  # out
    places: Annotated[IntArray, "n, PLACE"],  # out, as the next
    boxes: Annotated[IntArray, "n, BOX"],  # out, only of larger ones
    counts: Annotated[IntArray, "slices, tiles_x * tiles_y + SPARE_COUNTS"],  # out
    totals: Annotated[LongArray, "slices + 1"],  # out, pairs of each slice
    tiles_per_gauss: Annotated[IntArray, "R if dense else 0"],  # out
    n: int,
    rows: int,
    stride: int,
    channels: int,
    slices: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
    dense: int,
    limited: int,
    optimizations: int,
) -> None: ...


@worker(read_kernel("scan_pairs.h"), items="1", grain="1")
def scan_pairs(
    # In: counts; out: where each slice starts in each tile's list.
    counts: Annotated[IntArray, "slices, tiles + SPARE_COUNTS"],
    totals: Annotated[LongArray, "slices + 1"],  # in: pairs of each slice; out: running sum
    tile_start: Annotated[IntArray, "tiles + 1"],  # out
    slices: int,
    tiles: int,
) -> None: ...


@worker(read_kernel("fill_pairs.h"), items="slices", grain="1")
def fill_pairs(
    visible: Annotated[IntArray, "n"],
    depths: Annotated[FloatArray, "rows"],
    records: Annotated[FloatArray, "n, RECORD"],
    listed: Annotated[IntArray, "n"],
    listed_count: Annotated[IntArray, "slices"],
    places: Annotated[IntArray, "n, PLACE"],
    boxes: Annotated[IntArray, "n, BOX"],
    ranges: Annotated[IntArray, "tiles_x * tiles_y if limited else 0, 2"],
    counts: Annotated[IntArray, "slices, tiles_x * tiles_y + SPARE_COUNTS"],  # next free place
    totals: Annotated[LongArray, "slices + 1"],
    pair_start: Annotated[IntArray, "n + 1"],  # out
    pair_record: Annotated[IntArray, "P"],  # out
    unsorted: Annotated[LongArray, "P"],  # out, depth and number of each pair
    n: int,
    rows: int,
    slices: int,
    width: float,
    tiles_x: int,
    tiles_y: int,
    limited: int,
    optimizations: int,
) -> None: ...


@worker(read_kernel("sort_tiles.h"), items="tiles", grain="2")
def sort_tiles(
    tile_start: Annotated[IntArray, "tiles + 1"],
    pair_record: Annotated[IntArray, "P"],
    unsorted: Annotated[LongArray, "P"],
    buffer: Annotated[LongArray, "P"],  # scratch
    tile_list: Annotated[IntArray, "P"],  # out
    tile_place: Annotated[IntArray, "P"],  # out
    tiles: int,
) -> None: ...


@dataclass
class Bins:
    """Tile lists of one image.

    Attributes:
        visible: [M] int32, rows of the visible Gaussians.
        listed: [M] int32, place in `visible` of each record.
        listed_count: [slices] int32, records of each slice of `visible`, which lie where the slice begins.
        records: [M, RECORD] float32, what the blend reads of each of them that has pairs.
        tile_start: [tiles + 1] int32, begin of each tile's part of the lists, row-major.
        tile_list: [P] int32, records, front to back in every tile as far as it is sorted.
        tile_place: [P] int32, number of the pair; pairs are numbered by row and tile.
        pair_start: [M + 1] int32, number of each visible Gaussian's first pair.
        pair_record: [P] int32, record of each pair.
        unsorted: [P] int64, depth and number of the pairs of each tile.
        tiles_per_gauss: [R] int32, number of tiles of every row.
    """

    visible: Tensor
    listed: Tensor
    listed_count: Tensor
    records: Tensor
    tile_start: Tensor
    tile_list: Tensor
    tile_place: Tensor
    pair_start: Tensor
    pair_record: Tensor
    unsorted: Tensor
    tiles_per_gauss: Tensor

    def sort(self) -> None:
        """Sorts the lists of all tiles to their ends."""
        buffer = longs(len(self.unsorted))
        sort_tiles(
            self.tile_start, self.pair_record, self.unsorted, buffer, self.tile_list, self.tile_place,
            len(self.tile_start) - 1,
        )  # fmt: skip

    def pack_colors(self, colors: Tensor, first: int, count: int) -> None:
        """Puts `count` channels of `colors` [R, D], from `first` on, into the records."""
        _pack_colors(
            self.visible, self.listed, self.listed_count, colors, self.records,
            len(self.visible), len(self.listed_count), colors.shape[1], first, count,
        )  # fmt: skip


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
    dense: bool = True,
    ranges: Tensor | None = None,  # [tiles, 2] int32
    before: int = 0,
) -> Bins:
    """Lists the visible Gaussians of one image per tile, not yet sorted by depth, with their first channels.

    With `ranges`, only at depths, as bits of float32, that lie between the two numbers of the tile; other lists hold
    `before` pairs. `tiles_per_gauss` is empty unless `dense`, and counts all tiles.

    Raises:
        ValueError: There are more (tile, Gaussian) pairs than can be listed.
    """
    n = visible.numel()
    tiles_x, tiles_y = tiles(width, height)
    rows, channels = colors.shape
    # Any number of slices gives the same lists; some per thread keep all busy.
    slices = 1 if n < 1024 or get_num_threads() == 1 else SLICES * get_num_threads()
    limited = ranges is not None
    ranges = ints(0) if ranges is None else ranges
    records, listed, listed_count = floats(n, RECORD), ints(n), ints(slices)
    places, boxes, counts = ints(n, PLACE), ints(n, BOX), ints(slices, tiles_x * tiles_y + SPARE_COUNTS)
    tile_start, pair_start = ints(tiles_x * tiles_y + 1), ints(n + 1)
    tiles_per_gauss, totals = ints(rows if dense else 0), longs(slices + 1)
    pack_and_count(
        visible, means2d, depths, conics, opacities, sigmas, colors, ranges, records, listed, listed_count, places,
        boxes, counts, totals, tiles_per_gauss,
        n, rows, channels, min(channels, MAX_CHANNELS), slices, float(width), float(height), tiles_x, tiles_y,
        int(dense), int(limited), active_optimizations(),
    )  # fmt: skip
    scan_pairs(counts, totals, tile_start, slices, tiles_x * tiles_y)
    pairs = totals.tolist()[-1]
    covered = before + pairs
    if covered > MAX_PAIRS:
        raise ValueError(
            f"{n:,} visible Gaussians cover {covered:,} tiles of an image of {width}x{height} pixels in all, at most "
            f"{MAX_PAIRS:,} can be listed: render a smaller image, or fewer or smaller Gaussians."
        )
    pair_record, unsorted = ints(pairs), longs(pairs)
    fill_pairs(
        visible, depths, records, listed, listed_count, places, boxes, ranges, counts, totals, pair_start, pair_record,
        unsorted, n, rows, slices, float(width), tiles_x, tiles_y, int(limited), active_optimizations(),
    )  # fmt: skip
    lists = ints(pairs), ints(pairs)
    return Bins(
        visible, listed, listed_count, records, tile_start, *lists, pair_start, pair_record, unsorted, tiles_per_gauss
    )
