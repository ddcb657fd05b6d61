"""Counts that forks of Inria's rasterizer collect while they blend, computed from sorted tile lists."""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .structs import Grid, RecordArray

# Sums of a (tile, Gaussian) pair over the pixels in which it contributes: the number of these pixels, the Gaussian's
# weight in the colour, the transmittance in front of it, the values of the pixels, values times weight, and the
# distance in pixels from its centre. In C++ the names in upper case are the indices of the sums.
STATISTICS = ("pixels", "weight", "light", "value", "weighted_value", "distance")
# Floats of a pair: the kernel adds up eight vectors at a time.
STATISTICS_FLOATS = 8


class SortedLists(NamedTuple):
    """The tile lists of one image, sorted whole."""

    records: Annotated[RecordArray, "M, RECORD_FLOATS"]
    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    tile_record: Annotated[IntArray, "P"]  # record of each pair
    tile_row: Annotated[IntArray, "P"]  # Gaussian of each pair


class StatisticsMaps(NamedTuple):
    """Per-pixel counts."""

    contributions: Annotated[IntOutput, "grid.height, grid.width"]  # number of Gaussians that contribute
    # The Gaussian with the largest weight; -1 if none contributes.
    strongest: Annotated[IntOutput, "grid.height, grid.width"]


@worker(
    file="blend_statistics.h",
    items="grid.tiles_x * grid.tiles_y",
    grain="2",
    constants={"STATISTICS_FLOATS": STATISTICS_FLOATS, **{name.upper(): i for i, name in enumerate(STATISTICS)}},
)
def blend_statistics(
    *,
    lists: SortedLists,
    values: Annotated[FloatArray, "grid.height, grid.width"],
    pair_sums: Annotated[FloatOutput, "lists.P, STATISTICS_FLOATS"],  # `STATISTICS`, and zeros
    maps: StatisticsMaps,
    grid: Grid,
) -> None: ...
