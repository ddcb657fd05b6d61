"""Front-to-back compositing of one image and its adjoint, one tile at a time, a patch of pixels as one value.

Cut-offs as in gsplat and Inria's rasterizer: alpha is at most 0.999, a contribution under 1/255 is dropped, and a
pixel is finished when the next Gaussian would bring its transmittance to 1e-4 or less.

A tile is 16 patches of 4 x 4 pixels, or 32 of 4 x 2 where registers hold eight floats, and a patch is one value: small
Gaussians fill more of a square than of a row. Which patches a Gaussian reaches is found for several Gaussians at once
(`kernels/lib/reached_patches.h`). The forward pass then takes patch after patch, so that its pixels stay in registers
while the Gaussians pass, four of them side by side.

The adjoint walks the same lists back to front, Gaussian after Gaussian, so that here its sums stay in registers, and
visits only patches in which the forward pass blended the Gaussian. It needs, beside the colour, the moments of v_sigma
about the centre: of 1, dx, dy, dx^2, dx dy and dy^2. Each (tile, Gaussian) pair that was blended writes its sums to a
slot of its own, in the order of the lists, and `reduce_pairs` adds a Gaussian's pairs in a fixed order and makes
gradients of them: no atomics, and bit-equal for any thread count.
"""

from typing import Annotated, NamedTuple

from ..runtime.launch import worker
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput
from .binning import TileLists
from .structs import Channels, Grid, PairSums, SplatGradients


class Pixels(NamedTuple):
    """What the forward pass writes for each pixel."""

    image: Annotated[FloatOutput, "grid.height, grid.width, channels.stride"]
    transmittance: Annotated[FloatOutput, "grid.height, grid.width"]  # behind the last Gaussian blended
    alpha: Annotated[FloatOutput, "grid.height if with_alpha else 0, grid.width"]  # 1 - transmittance
    pixel_stop: Annotated[IntOutput, "grid.height, grid.width"]  # index in the lists behind the last Gaussian blended
    # Where a pass over the lists left off, for the next one: the transmittance that goes on in finished pixels, too;
    # by tile whether some pixel is not finished.
    product_left: Annotated[FloatOutput, "grid.height if part.unfinished or part.continued else 0, grid.width"]
    still_open: Annotated[IntOutput, "grid.tiles_x * grid.tiles_y if part.unfinished or part.continued else 0"]


class BlendedPairs(NamedTuple):
    """Which pairs were blended."""

    tile_stop: Annotated[IntOutput, "grid.tiles_x, grid.tiles_y"]  # the greatest `pixel_stop` of a tile
    tile_blended: Annotated[IntOutput, "grid.tiles_x, grid.tiles_y"]  # their number
    pair_patches: Annotated[IntOutput, "lists.P"]  # patches where each was blended, as bits; nothing beyond `tile_stop`


class ListPart(NamedTuple):
    """Which part of two-pass lists these are."""

    before: int  # pairs of the lists in front of these, where an earlier pass ended
    continued: int  # whether there was one
    unfinished: int  # whether there may be a later one


class BlendedList(NamedTuple):
    """A part of the lists, as far as it was blended."""

    records: Annotated[FloatArray, "M, RECORD"]
    tile_start: Annotated[IntArray, "grid.tiles_x * grid.tiles_y + 1"]
    tile_stop: Annotated[IntArray, "grid.tiles_x, grid.tiles_y"]


class BackwardPairs(NamedTuple):
    """Pairs of all parts of the lists, as the adjoint walks them."""

    tile_record: Annotated[IntArray, "P"]
    tile_pair: Annotated[IntArray, "P"]
    pair_patches: Annotated[IntArray, "P"]
    slot_end: Annotated[IntArray, "parts * grid.tiles_x * grid.tiles_y"]  # of each tile, in the order of the lists


class FinalPixels(NamedTuple):
    """What the adjoint reads of the forward pass."""

    transmittance: Annotated[FloatArray, "grid.height, grid.width"]
    pixel_stop: Annotated[IntArray, "grid.height, grid.width"]


class PixelGradients(NamedTuple):
    """Gradients of the pixels."""

    image: Annotated[FloatArray, "grid.height, grid.width, channels.stride"]
    transmittance: Annotated[FloatArray, "grid.height if with_transmittance else 0, grid.width"]  # of the final one


class PairSlots(NamedTuple):
    """Sums of pairs, in the order of the lists."""

    pair_slot: Annotated[IntOutput, "pairs.P"]  # zeros before; 1 + the slot of each pair, 0 if it was not blended
    sums: Annotated[FloatOutput, "Q, PAIR"]  # a `PairSum` each


def blend_forward(
    *,
    packed: Annotated[FloatArray, "M, RECORD"],
    lists: TileLists,
    pixels: Pixels,
    blended: BlendedPairs,
    grid: Grid,
    channels: Channels,
    part: ListPart,
    with_alpha: int,
    optimizations: int,
) -> None:
    """The stub of the forward kernels."""


def blend_adjoint(
    *,
    near: BlendedList,
    far: BlendedList,  # the second part of the lists, if there is one
    pairs: BackwardPairs,
    pixels: FinalPixels,
    v_pixels: PixelGradients,
    slots: PairSlots,
    grid: Grid,
    channels: Channels,
    with_transmittance: int,
    parts: int,
    optimizations: int,
) -> None:
    """The stub of their adjoints."""


# Channels that kernels are compiled for. One and three are the common cases (depth, colour); four serve colour + depth
# and wider features.
_WIDTHS = (1, 3, 4)
_TILES = "grid.tiles_x * grid.tiles_y"

FORWARD = {
    width: worker(
        file="blend_forward.h", items=_TILES, grain="2", name=f"blend_forward_{width}", constants={"D": width}
    )(blend_forward)
    for width in _WIDTHS
}
ADJOINT = {
    (width, absgrad): worker(
        file="blend_adjoint.h",
        items=_TILES,
        grain="2",
        name=f"blend_adjoint_{width}{'_abs' if absgrad else ''}",
        constants={"D": width, "ABSGRAD": int(absgrad)},
    )(blend_adjoint)
    for width in _WIDTHS
    for absgrad in (False, True)
}


def compiled_width(channels: int) -> int:
    """The number of channels, of those that kernels are compiled for, that fits `channels` (1 to MAX_CHANNELS) best."""
    return min(width for width in _WIDTHS if width >= channels)


@worker(file="reduce_pairs.h", items="(n + BLOCK - 1) / BLOCK", grain="1")
def reduce_pairs(
    *,
    sums: PairSums,
    conics: Annotated[FloatArray, "n, 3"],
    opacities: Annotated[FloatArray, "n"],
    # Zeros where not visible; added to from the second pass over the channels on, but for the colours, which have their
    # own channels.
    v_splats: SplatGradients,
    n: int,
    channels: Channels,
    absgrad: int,
    parts: int,
) -> None: ...
