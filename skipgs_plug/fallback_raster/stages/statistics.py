"""What the forks of Inria's rasterizer count inside their blend, by a walk through sorted tile lists."""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .structs import Grid

SUMS = 8  # floats per (tile, Gaussian) pair; the kernel uses six, and adds up eight at a time


class SortedLists(NamedTuple):
    """Tile lists of one image, sorted to their ends."""

    records: Annotated[FloatArray, "M, RECORD"]
    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    tile_record: Annotated[IntArray, "P"]  # record of each pair
    tile_row: Annotated[IntArray, "P"]  # its Gaussian


class StatisticsMaps(NamedTuple):
    """What is counted for each pixel."""

    contributions: Annotated[IntOutput, "grid.height, grid.width"]  # Gaussians that contribute
    strongest: Annotated[IntOutput, "grid.height, grid.width"]  # the one with the largest share; -1 where there is none


@worker(file="blend_statistics.h", items="grid.tiles_x * grid.tiles_y", grain="2", constants={"SUMS": SUMS})
def blend_statistics(
    *,
    lists: SortedLists,
    values: Annotated[FloatArray, "grid.height, grid.width"],
    # Of each pair: pixels, and sums over them of the share of their colour, the light that reaches the Gaussian, the
    # values, values times share, and distances from its centre.
    pair_sums: Annotated[FloatOutput, "lists.P, SUMS"],
    maps: StatisticsMaps,
    grid: Grid,
) -> None: ...
