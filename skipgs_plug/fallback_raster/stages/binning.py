"""Lists the Gaussians that touch each tile, front to back.

The kernels go through the visible rows twice: once to count the pairs of each tile, once to list them. Each tile then
sorts its own list, and only as far as its pixels need it (`kernels/lib/sorted_tile.h`). In a scene of a million
Gaussians most of a list lies behind a surface and is never read. Gaussians of equal depth keep the order of the input.
A Gaussian is listed only in tiles that its ellipse alpha = 1/255 crosses (exact bounds per row of tiles,
`kernels/lib/ellipse.h`).
"""

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from torch import Tensor

from ..runtime.buffers import floats, ints, longs
from ..runtime.constants import BOX_INTS, FOOTPRINT_INTS, MAX_CHANNELS, RECORD_FLOATS, SPARE_COUNTS
from ..runtime.launch import worker
from ..runtime.optimizations import active_optimizations
from ..runtime.parameters import FloatArray, IntArray, IntOutput, LongOutput
from ..runtime.threads import get_num_threads
from .structs import Channels, DepthRangeArray, FootprintOutput, Grid, RecordOutput, Splats, TileBoxOutput, grid

# Most (tile, Gaussian) pairs of an image: kernels number pairs with 32-bit ints.
MAX_PAIRS = 2**31 - 1

# Slices of the rows for each thread. Several slices keep threads from waiting for one with expensive rows. Their number
# does not change the lists.
SLICES_PER_THREAD = 4


class Slices(NamedTuple):
    """Division of the list of visible Gaussians into slices of equal length, one for each item of a kernel."""

    m: int  # number of visible Gaussians
    number: int  # number of slices


class RecordList(NamedTuple):
    """Records of the visible Gaussians that have pairs. Each slice begins where its Gaussians begin."""

    records: Annotated[RecordOutput, "slices.m, RECORD_FLOATS"]
    listed: Annotated[IntOutput, "slices.m"]  # index of each record's Gaussian among the visible ones
    listed_count: Annotated[IntOutput, "slices.number"]  # number of records in each slice


class PackFlags(NamedTuple):
    """Options of `pack_and_count`."""

    dense: int  # 1 to count the tiles of all rows, also of those that are not listed
    optimizations: int  # bits of `OPTIMIZATIONS`


class Footprints(NamedTuple):
    """The tiles that the ellipse of each record meets: of a small box as bits, else the box."""

    tiles: Annotated[FootprintOutput, "slices.m, FOOTPRINT_INTS"]
    boxes: Annotated[TileBoxOutput, "slices.m, BOX_INTS"]  # written only for boxes that are too large for the bits


class PairCounts(NamedTuple):
    """Numbers of pairs by slice. `scan_pairs` turns them into start positions."""

    of_tiles: Annotated[IntOutput, "slices.number, grid.tiles_x * grid.tiles_y + SPARE_COUNTS"]
    of_slices: Annotated[LongOutput, "slices.number + 1"]


class DepthRanges(NamedTuple):
    """The range of depths, as bits of float32, that each tile lists."""

    ranges: Annotated[DepthRangeArray, "grid.tiles_x * grid.tiles_y if limited else 0, DEPTH_RANGE_INTS"]
    limited: int  # 1 if there are ranges; 0 lists all depths


class Pairs(NamedTuple):
    """The (tile, Gaussian) pairs, numbered by row, then tile."""

    start: Annotated[IntOutput, "slices.m + 1"]  # number of each visible Gaussian's first pair
    record: Annotated[IntOutput, "P"]
    unsorted: Annotated[LongOutput, "P"]  # by tile: depth in the upper 32 bits, number of the pair in the lower


class TileLists(NamedTuple):
    """The pairs of each tile, which kernels sort front to back, whole or as far as the pixels need."""

    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    pair_record: Annotated[IntArray, "P"]
    unsorted: Annotated[LongOutput, "P"]
    buffer: Annotated[LongOutput, "0 if sorted else P"]  # scratch
    tile_record: Annotated[IntOutput, "P"]  # output: record of each pair, by tile
    tile_pair: Annotated[IntOutput, "P"]  # output: number of each pair
    sorted: int  # 1 if the lists are sorted already


@worker(file="pack_colors.h", items="slices.number", grain="1")
def _pack_colors(
    *,
    visible: Annotated[IntArray, "slices.m"],
    packed: RecordList,  # the kernel replaces the colours
    colors: Annotated[FloatArray, "n, channels.stride"],
    channels: Channels,
    slices: Slices,
    n: int,
) -> None: ...


@worker(file="pack_and_count.h", items="slices.number", grain="1")
def pack_and_count(
    *,
    visible: Annotated[IntArray, "slices.m"],
    splats: Splats,
    colors: Annotated[FloatArray, "n, channels.stride"],
    channels: Channels,
    depths: DepthRanges,
    packed: RecordList,
    footprints: Footprints,
    counts: PairCounts,
    tiles_per_gauss: Annotated[IntOutput, "n if flags.dense else 0"],
    grid: Grid,
    slices: Slices,
    n: int,
    flags: PackFlags,
) -> None: ...


@worker(file="scan_pairs.h", items="1", grain="1")
def scan_pairs(
    *,
    counts: PairCounts,  # input: numbers of pairs; output: start of each slice in each tile's list, and its first pair
    tile_start: Annotated[IntOutput, "grid.tiles_x * grid.tiles_y + 1"],
    grid: Grid,
    slices: Slices,
) -> None: ...


@worker(file="fill_pairs.h", items="slices.number", grain="1")
def fill_pairs(
    *,
    visible: Annotated[IntArray, "slices.m"],
    splat_depths: Annotated[FloatArray, "n"],
    packed: RecordList,
    footprints: Footprints,
    depths: DepthRanges,
    counts: PairCounts,  # next free position of each slice in each tile's list
    pairs: Pairs,
    grid: Grid,
    slices: Slices,
    n: int,
    optimizations: int,
) -> None: ...


@worker(file="sort_tiles.h", items="grid.tiles_x * grid.tiles_y", grain="2")
def sort_tiles(*, lists: TileLists, grid: Grid) -> None: ...


@dataclass
class Bins:
    """Tile lists of one image.

    Attributes:
        visible: [M] int32, rows of the visible Gaussians.
        packed: Records of the visible Gaussians that have pairs.
        tile_start: [tiles + 1] int32, start of each tile's part of the lists, row-major.
        tile_record: [P] int32, record of each pair, front to back in each tile as far as it is sorted.
        tile_pair: [P] int32, number of each pair; pairs are numbered by row, then tile.
        pairs: First pair of each Gaussian; records and depths of pairs, which are freed once the lists are sorted.
        tiles_per_gauss: [R] int32, number of tiles of each row.
        grid: The image and its tiles.
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
        """Return the lists for a kernel, with a buffer to sort them unless they are sorted."""
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
        """Sort the whole lists of all tiles."""
        sort_tiles(lists=self.lists(sorted=False), grid=self.grid)

    def pack_colors(self, colors: Tensor, channels: Channels) -> None:
        """Copy some channels of `colors` [R, D] to the records."""
        _pack_colors(
            visible=self.visible,
            packed=self.packed,
            colors=colors,
            channels=channels,
            slices=Slices(len(self.visible), len(self.packed.listed_count)),
            n=len(colors),
        )


def bin_gaussians(
    visible: Tensor,  # [M] int32
    splats: Splats,
    colors: Tensor,  # [R, D]
    width: int,
    height: int,
    dense: bool = True,
    ranges: Tensor | None = None,  # [tiles, DEPTH_RANGE_INTS] int32
    before: int = 0,
) -> Bins:
    """List the visible Gaussians of one image per tile, not yet sorted by depth.

    Args:
        visible: Rows of the visible Gaussians, ascending.
        splats: Projected Gaussians, R rows.
        colors: Their colours. The records receive the first MAX_CHANNELS channels.
        width: Image width in pixels.
        height: Image height in pixels.
        dense: Whether to count the tiles of all rows in `tiles_per_gauss`, including pairs outside `ranges`.
        ranges: Depths that each tile lists, a `DepthRange` each. None lists all depths.
        before: Pairs in other lists of the same image. They count towards the limit.

    Returns:
        The lists.

    Raises:
        ValueError: There are more (tile, Gaussian) pairs than can be listed.
    """
    m = visible.numel()
    tiling = grid(width, height)
    n, channels = colors.shape
    # A few rows are not worth several slices.
    slices = Slices(m, 1 if m < 1024 or get_num_threads() == 1 else SLICES_PER_THREAD * get_num_threads())
    depths = DepthRanges(ints(0) if ranges is None else ranges, int(ranges is not None))
    packed = RecordList(floats(m, RECORD_FLOATS), ints(m), ints(slices.number))
    footprints = Footprints(ints(m, FOOTPRINT_INTS), ints(m, BOX_INTS))
    tile_count = tiling.tiles_x * tiling.tiles_y
    counts = PairCounts(ints(slices.number, tile_count + SPARE_COUNTS), longs(slices.number + 1))
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
        slices=slices,
        n=n,
        flags=PackFlags(int(dense), active_optimizations()),
    )
    scan_pairs(counts=counts, tile_start=tile_start, grid=tiling, slices=slices)
    total = counts.of_slices.tolist()[-1]
    covered = before + total
    if covered > MAX_PAIRS:
        raise ValueError(
            f"{m:,} visible Gaussians cover {covered:,} tiles of an image of {width}x{height} pixels in all, but at "
            f"most {MAX_PAIRS:,} can be listed: render a smaller image, or fewer or smaller Gaussians."
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
        slices=slices,
        n=n,
        optimizations=active_optimizations(),
    )
    return Bins(visible, packed, tile_start, ints(total), ints(total), pairs, tiles_per_gauss, tiling)
