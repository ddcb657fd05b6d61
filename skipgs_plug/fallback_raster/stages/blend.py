"""Front-to-back compositing of one image and its adjoint, one tile at a time.

The cut-offs are those of gsplat and Inria's rasterizer. Alpha is at most 0.999. A contribution with an alpha under
1/255 is dropped. A pixel is finished when the next Gaussian would reduce its transmittance to 1e-4 or less.

A tile is divided into 16 patches of 4 x 4 pixels, or 32 of 4 x 2 on processors whose registers hold eight floats. A
patch is one vector: small Gaussians fill more of a square than of a row. The patches that a Gaussian reaches are found
for several Gaussians at once (`kernels/lib/reached_patches.h`). The forward pass then processes one patch after the
other, so that the pixels of the patch stay in registers, and interleaves four Gaussians at a time.

The adjoint goes through the same lists back to front, one Gaussian after the other, so that the sums of the Gaussian
stay in registers. It visits only patches in which the forward pass blended the Gaussian. Besides the gradient of the
colour it needs the moments of v_sigma about the 2D mean: those of 1, dx, dy, dx^2, dx dy and dy^2. Each blended (tile,
Gaussian) pair writes its sums to a slot of its own, in the order of the lists. `reduce_pairs` adds up the pairs of each
Gaussian in a fixed order and turns them into gradients. There are no atomic additions, so gradients are bit-equal for
any number of threads.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .binning import TileLists
from .structs import BLOCKS, Channels, Grid, PairSumOutput, PairSums, RecordArray, SplatGradients


class Pixels(NamedTuple):
    """Per-pixel outputs of the forward pass."""

    image: Annotated[FloatOutput, "grid.height, grid.width, channels.stride"]
    transmittance: Annotated[FloatOutput, "grid.height, grid.width"]  # behind the last blended Gaussian
    alpha: Annotated[FloatOutput, "grid.height if with_alpha else 0, grid.width"]  # 1 - transmittance
    pixel_stop: Annotated[IntOutput, "grid.height, grid.width"]  # list index behind the last blended Gaussian
    # The state at the end of a pass over the lists, for the next pass: the product of all 1 - alpha so far, which also
    # continues in finished pixels; and, by tile, whether some pixel is not finished.
    product_left: Annotated[FloatOutput, "grid.height if part.unfinished or part.continued else 0, grid.width"]
    still_open: Annotated[IntOutput, "grid.tiles_x * grid.tiles_y if part.unfinished or part.continued else 0"]


class BlendedPairs(NamedTuple):
    """The pairs that were blended."""

    tile_stop: Annotated[IntOutput, "grid.tiles_x, grid.tiles_y"]  # largest `pixel_stop` of each tile
    tile_blended: Annotated[IntOutput, "grid.tiles_x, grid.tiles_y"]  # number of blended pairs of each tile
    pair_patches: Annotated[IntOutput, "lists.P"]  # bits of patches that blended each pair, up to `tile_stop`


class ListPart(NamedTuple):
    """The part of two-pass lists that a launch blends."""

    before: int  # number of pairs in the lists of an earlier pass
    continued: int  # 1 if there was an earlier pass
    unfinished: int  # 1 if there may be a later pass


class BlendedList(NamedTuple):
    """The blended part of the lists of one pass."""

    records: Annotated[RecordArray, "M, RECORD_FLOATS"]
    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    tile_stop: Annotated[IntArray, "grid.tiles_x, grid.tiles_y"]


class BackwardPairs(NamedTuple):
    """The pairs of all passes, for the adjoint."""

    tile_record: Annotated[IntArray, "P"]
    tile_pair: Annotated[IntArray, "P"]
    pair_patches: Annotated[IntArray, "P"]
    slot_end: Annotated[IntArray, "parts * grid.tiles_x * grid.tiles_y"]  # end of the slots of each tile
    parts: int  # number of passes over the lists: 1 or 2


class FinalPixels(NamedTuple):
    """Per-pixel results of the forward pass that the adjoint reads."""

    transmittance: Annotated[FloatArray, "grid.height, grid.width"]
    pixel_stop: Annotated[IntArray, "grid.height, grid.width"]


class PixelGradients(NamedTuple):
    """Gradients of the loss with respect to the pixels."""

    image: Annotated[FloatArray, "grid.height, grid.width, channels.stride"]
    transmittance: Annotated[FloatArray, "grid.height if with_transmittance else 0, grid.width"]


class PairSlots(NamedTuple):
    """The slots of the sums of blended pairs, in the order of the lists."""

    pair_slot: Annotated[IntOutput, "pairs.P"]  # 1 + slot of each pair; 0, as before the call, if it was not blended
    sums: Annotated[PairSumOutput, "Q, PAIR_FLOATS"]


def blend_forward(
    *,
    records: Annotated[RecordArray, "M, RECORD_FLOATS"],
    lists: TileLists,
    pixels: Pixels,
    blended: BlendedPairs,
    grid: Grid,
    channels: Channels,
    part: ListPart,
    with_alpha: int,
    optimizations: int,
) -> None:
    """Stub of the forward kernels."""


def blend_adjoint(
    *,
    near: BlendedList,
    far: BlendedList,  # lists of the second pass; `near` again if there was none
    pairs: BackwardPairs,
    pixels: FinalPixels,
    v_pixels: PixelGradients,
    slots: PairSlots,
    grid: Grid,
    channels: Channels,
    with_transmittance: int,
    optimizations: int,
) -> None:
    """Stub of the adjoint kernels."""


# Numbers of channels that kernels are compiled for. One (depth) and three (colour) are the common cases. Four serve
# colour with depth, and wider features.
_COMPILED_CHANNELS = (1, 3, 4)
_TILES = "grid.tiles_x * grid.tiles_y"

FORWARD = {
    number: worker(
        file="blend_forward.h",
        items=_TILES,
        grain="2",
        name=f"blend_forward_{number}",
        constants={"COMPILED_CHANNELS": number},
    )(blend_forward)
    for number in _COMPILED_CHANNELS
}
ADJOINT = {
    (number, absgrad): worker(
        file="blend_adjoint.h",
        items=_TILES,
        grain="2",
        name=f"blend_adjoint_{number}{'_abs' if absgrad else ''}",
        constants={"COMPILED_CHANNELS": number, "ABSGRAD": int(absgrad)},
    )(blend_adjoint)
    for number in _COMPILED_CHANNELS
    for absgrad in (False, True)
}


def compiled_channels(channels: int) -> int:
    """Return the smallest number of channels with a compiled kernel that holds `channels` (1 to MAX_CHANNELS)."""
    return min(number for number in _COMPILED_CHANNELS if number >= channels)


@worker(file="reduce_pairs.h", items=BLOCKS, grain="1")
def reduce_pairs(
    *,
    sums: PairSums,
    conics: Annotated[FloatArray, "n, 3"],
    opacities: Annotated[FloatArray, "n"],
    # Zeros for rows that are not visible. From the second pass over the channels on, the kernel adds to all but the
    # colours, of which each pass writes its own channels.
    v_splats: SplatGradients,
    n: int,
    channels: Channels,
    absgrad: int,
) -> None: ...
