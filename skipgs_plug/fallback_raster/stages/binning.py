"""Which Gaussians touch which tile, front to back.

Rows are taken in their order twice, to count the pairs of each tile and to list them, and every tile then sorts its own
list, only as far as its pixels take it (`kernels/lib/sorted_tile.h`): behind the surface of a scene of a million
Gaussians most of a list is never looked at. Equal depths keep the order of the input. A tile is listed only where the
ellipse at alpha = 1/255 really crosses it (exact bounds per row of tiles, `kernels/lib/ellipse.h`).
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from torch import Tensor

from ..runtime.buffers import floats, ints, longs
from ..runtime.constants import BOX, FOOTPRINT, MAX_CHANNELS, RECORD, SPARE_COUNTS
from ..runtime.launch import worker
from ..runtime.optimizations import active_optimizations
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput, LongOutput
from ..runtime.threads import get_num_threads
from .structs import Channels, Grid, Splats, grid

# Pairs that a list can hold: they are numbered in 32 bits.
MAX_PAIRS = 2**31 - 1

# Slices of the rows that each thread counts and lists: a few, so that none waits for another's expensive rows.
SLICES = 4


class RecordList(NamedTuple):
    """What the blend reads of each of `m` visible Gaussians that has pairs, by slice of these Gaussians."""

    records: Annotated[FloatOutput, "m, RECORD"]  # a `Record` each, from where their slice begins
    listed: Annotated[IntOutput, "m"]  # index of each among the visible Gaussians
    listed_count: Annotated[IntOutput, "slices"]  # records of each slice


class Footprints(NamedTuple):
    """Which tiles each record covers, as far as its box tells."""

    tiles: Annotated[IntOutput, "m, FOOTPRINT"]
    boxes: Annotated[IntOutput, "m, BOX"]  # a `TileBox`, only of larger ones


class PairCounts(NamedTuple):
    """Numbers of pairs, which `scan_pairs` turns into where they begin."""

    of_tiles: Annotated[IntOutput, "slices, grid.tiles_x * grid.tiles_y + SPARE_COUNTS"]
    of_slices: Annotated[LongOutput, "slices + 1"]


class DepthRanges(NamedTuple):
    """Depths, as bits of float32, that each tile lists."""

    ranges: Annotated[IntArray, "grid.tiles_x * grid.tiles_y if limited else 0, 2"]  # the first, and the first beyond
    limited: int  # whether there are ranges; all depths otherwise


class Pairs(NamedTuple):
    """(tile, Gaussian) pairs, numbered by row and tile."""

    start: Annotated[IntOutput, "m + 1"]  # number of the first pair of each visible Gaussian
    record: Annotated[IntOutput, "P"]
    unsorted: Annotated[LongOutput, "P"]  # depth and number of the pairs of each tile


class TileLists(NamedTuple):
    """Pairs of each tile, to be sorted front to back, all or as far as the pixels take them."""

    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    pair_record: Annotated[IntArray, "P"]
    unsorted: Annotated[LongOutput, "P"]
    buffer: Annotated[LongOutput, "0 if sorted else P"]  # scratch
    tile_record: Annotated[IntOutput, "P"]  # out, record of each pair, in the order of the tiles
    tile_pair: Annotated[IntOutput, "P"]  # out, its number
    sorted: int  # whether they are


@worker(file="pack_colors.h", items="slices", grain="1")
def _pack_colors(
    *,
    visible: Annotated[IntArray, "m"],
    packed: RecordList,  # the channels are replaced
    colors: Annotated[FloatArray, "n, channels.stride"],
    channels: Channels,
    m: int,
    n: int,
    slices: int,
) -> None: ...


@worker(file="pack_and_count.h", items="slices", grain="1")
def pack_and_count(
    *,
    visible: Annotated[IntArray, "m"],
    splats: Splats,
    colors: Annotated[FloatArray, "n, channels.stride"],
    channels: Channels,
    depths: DepthRanges,
    packed: RecordList,
    footprints: Footprints,
    counts: PairCounts,
    tiles_per_gauss: Annotated[IntOutput, "n if dense else 0"],
    grid: Grid,
    m: int,
    n: int,
    slices: int,
    dense: int,
    optimizations: int,
) -> None: ...


@worker(file="scan_pairs.h", items="1", grain="1")
def scan_pairs(
    *,
    counts: PairCounts,  # in: numbers of pairs; out: where each slice begins in each tile's list, and its first pair
    tile_start: Annotated[IntOutput, "grid.tiles_x * grid.tiles_y + 1"],
    grid: Grid,
    slices: int,
) -> None: ...


@worker(file="fill_pairs.h", items="slices", grain="1")
def fill_pairs(
    *,
    visible: Annotated[IntArray, "m"],
    splat_depths: Annotated[FloatArray, "n"],
    packed: RecordList,
    footprints: Footprints,
    depths: DepthRanges,
    counts: PairCounts,  # the next free place in each tile's list
    pairs: Pairs,
    grid: Grid,
    m: int,
    n: int,
    slices: int,
    optimizations: int,
) -> None: ...


@worker(file="sort_tiles.h", items="grid.tiles_x * grid.tiles_y", grain="2")
def sort_tiles(*, lists: TileLists, grid: Grid) -> None: ...


@dataclass
class Bins:
    """Tile lists of one image.

    Attributes:
        visible: [M] int32, rows of the visible Gaussians.
        packed: Records of each of them that has pairs.
        tile_start: [tiles + 1] int32, begin of each tile's part of the lists, row-major.
        tile_record: [P] int32, records, front to back in every tile as far as it is sorted.
        tile_pair: [P] int32, number of the pair; pairs are numbered by row and tile.
        pairs: First pairs of Gaussians; records and depths of pairs, which go once the lists are sorted.
        tiles_per_gauss: [R] int32, number of tiles of every row.
        grid: The tiles.
    """

    visible: Tensor
    packed: RecordList
    tile_start: Tensor
    tile_record: Tensor
    tile_pair: Tensor
    pairs: Pairs
    tiles_per_gauss: Tensor
    grid: Grid

    def lists(self, sorted: bool) -> TileLists:
        """The lists as kernels take them, with room to sort them unless they are sorted."""
        buffer = longs(0 if sorted else len(self.tile_record))
        return TileLists(
            tile_start=self.tile_start,
            pair_record=self.pairs.record,
            unsorted=self.pairs.unsorted,
            buffer=buffer,
            tile_record=self.tile_record,
            tile_pair=self.tile_pair,
            sorted=int(sorted),
        )

    def sort(self) -> None:
        """Sorts the lists of all tiles to their ends."""
        sort_tiles(lists=self.lists(sorted=False), grid=self.grid)

    def pack_colors(self, colors: Tensor, channels: Channels) -> None:
        """Puts some channels of `colors` [R, D] into the records."""
        _pack_colors(
            visible=self.visible,
            packed=self.packed,
            colors=colors,
            channels=channels,
            m=len(self.visible),
            n=len(colors),
            slices=len(self.packed.listed_count),
        )


def bin_gaussians(
    visible: Tensor,  # [M] int32
    splats: Splats,
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
    m = visible.numel()
    tiling = grid(width, height)
    n, channels = colors.shape
    # Any number of slices gives the same lists; some per thread keep all busy.
    slices = 1 if m < 1024 or get_num_threads() == 1 else SLICES * get_num_threads()
    depths = DepthRanges(ints(0) if ranges is None else ranges, int(ranges is not None))
    packed = RecordList(floats(m, RECORD), ints(m), ints(slices))
    footprints = Footprints(ints(m, FOOTPRINT), ints(m, BOX))
    tile_count = tiling.tiles_x * tiling.tiles_y
    counts = PairCounts(ints(slices, tile_count + SPARE_COUNTS), longs(slices + 1))
    tile_start, pair_start = ints(tile_count + 1), ints(m + 1)
    tiles_per_gauss = ints(n if dense else 0)
    pack_and_count(
        visible=visible,
        splats=splats,
        colors=colors,
        channels=Channels(channels, 0, min(channels, MAX_CHANNELS)),
        depths=depths,
        packed=packed,
        footprints=footprints,
        counts=counts,
        tiles_per_gauss=tiles_per_gauss,
        grid=tiling,
        m=m,
        n=n,
        slices=slices,
        dense=int(dense),
        optimizations=active_optimizations(),
    )
    scan_pairs(counts=counts, tile_start=tile_start, grid=tiling, slices=slices)
    total = counts.of_slices.tolist()[-1]
    covered = before + total
    if covered > MAX_PAIRS:
        raise ValueError(
            f"{m:,} visible Gaussians cover {covered:,} tiles of an image of {width}x{height} pixels in all, at most "
            f"{MAX_PAIRS:,} can be listed: render a smaller image, or fewer or smaller Gaussians."
        )
    pairs = Pairs(pair_start, ints(total), longs(total))
    fill_pairs(
        visible=visible,
        splat_depths=splats.depths,
        packed=packed,
        footprints=footprints,
        depths=depths,
        counts=counts,
        pairs=pairs,
        grid=tiling,
        m=m,
        n=n,
        slices=slices,
        optimizations=active_optimizations(),
    )
    return Bins(visible, packed, tile_start, ints(total), ints(total), pairs, tiles_per_gauss, tiling)
