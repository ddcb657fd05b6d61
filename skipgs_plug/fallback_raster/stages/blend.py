"""Front-to-back compositing of one image and its adjoint, one tile at a time, a block of pixels as one value.

Cut-offs as in gsplat and Inria's rasterizer: alpha is at most 0.999, a contribution under 1/255 is dropped, and a
pixel is finished when the next Gaussian would bring its transmittance to 1e-4 or less.

A tile is 16 blocks of 4 x 4 pixels, or 32 of 4 x 2 where registers hold eight floats, and a block is one value: small
Gaussians fill more of a square than of a row. Which blocks a Gaussian reaches is found for several Gaussians at once
(`kernels/lib/reached_blocks.h`). The forward pass then takes block after block, so that its pixels stay in registers
while the Gaussians pass, four of them side by side.

The adjoint walks the same lists back to front, Gaussian after Gaussian, so that here its sums stay in registers, and
visits only blocks in which the forward pass blended the Gaussian. It needs, beside the colour, the moments of v_sigma
about the centre: of 1, dx, dy, dx^2, dx dy and dy^2. Each (tile, Gaussian) pair that was blended writes its sums to a
slot of its own, in the order of the lists, and `reduce_pairs` adds a Gaussian's pairs in a fixed order and makes
gradients of them: no atomics, and bit-equal for any thread count.
"""

from typing import Annotated

from ..runtime.launch import FloatArray, IntArray, LongArray, Worker, worker
from ..runtime.source import read_kernel


def _forward(channels: int) -> Worker:
    @worker(
        read_kernel("blend_forward.h"),
        items="tiles_x * tiles_y",
        grain="2",
        name=f"blend_forward_{channels}",
        constants={"D": channels},
    )
    def blend_forward(
        records: Annotated[FloatArray, "M, RECORD"],
        tile_start: Annotated[IntArray, "tiles_x * tiles_y + 1"],
        pair_record: Annotated[IntArray, "P"],
        unsorted: Annotated[LongArray, "P"],
        buffer: Annotated[LongArray, "0 if sorted else P"],  # scratch
        tile_list: Annotated[IntArray, "P"],  # sorted, or sorted here as far as necessary; as the next
        tile_place: Annotated[IntArray, "P"],
        image: Annotated[FloatArray, "height, width, stride"],  # out
        transmittance: Annotated[FloatArray, "height, width"],  # out, behind the last Gaussian blended
        alpha: Annotated[FloatArray, "height if with_alpha else 0, width"],  # out, 1 - transmittance
        pixel_stop: Annotated[IntArray, "height, width"],  # out, place in tile_list behind the last Gaussian blended
        tile_stop: Annotated[IntArray, "tiles_x, tiles_y"],  # out, their maximum
        tile_blended: Annotated[IntArray, "tiles_x, tiles_y"],  # out, pairs that were blended
        pair_blocks: Annotated[IntArray, "P"],  # out, blocks where it was blended, as bits; nothing beyond tile_stop
        product_left: Annotated[FloatArray, "height if unfinished or continued else 0, width"],  # in and out
        still_open: Annotated[IntArray, "tiles_x * tiles_y if unfinished or continued else 0"],  # out
        width: int,
        height: int,
        tiles_x: int,
        tiles_y: int,
        stride: int,  # channels of the image
        channel: int,  # the first of this pass
        channels: int,
        sorted: int,  # whether the lists are
        before: int,  # pairs of the lists in front of these, where an earlier pass ended
        continued: int,  # whether there was one
        unfinished: int,  # whether there may be a later one
        with_alpha: int,
        optimizations: int,
    ) -> None: ...

    return blend_forward


def _backward(channels: int, absgrad: bool) -> Worker:
    @worker(
        read_kernel("blend_backward.h"),
        items="tiles_x * tiles_y",
        grain="2",
        name=f"blend_backward_{channels}{'_abs' if absgrad else ''}",
        constants={"D": channels, "ABSGRAD": int(absgrad)},
    )
    def blend_backward(
        records: Annotated[FloatArray, "M, RECORD"],
        tile_start: Annotated[IntArray, "tiles_x * tiles_y + 1"],
        tile_stop: Annotated[IntArray, "tiles_x, tiles_y"],
        far_records: Annotated[FloatArray, "F, RECORD"],  # of the second part of the lists, as the next two
        far_start: Annotated[IntArray, "tiles_x * tiles_y + 1"],
        far_stop: Annotated[IntArray, "tiles_x, tiles_y"],
        tile_list: Annotated[IntArray, "P"],
        tile_place: Annotated[IntArray, "P"],
        pair_blocks: Annotated[IntArray, "P"],
        slot_end: Annotated[IntArray, "parts * tiles_x * tiles_y"],  # of each tile, in the order of the lists
        transmittance: Annotated[FloatArray, "height, width"],
        pixel_stop: Annotated[IntArray, "height, width"],
        v_image: Annotated[FloatArray, "height, width, stride"],
        v_transmittance: Annotated[FloatArray, "height if with_transmittance else 0, width"],  # of the final one
        pair_slot: Annotated[IntArray, "P"],  # out, zeros before; 1 + the slot of each pair, 0 if it was not blended
        v_pairs: Annotated[FloatArray, "Q, PAIR"],  # out, the slots
        width: int,
        height: int,
        tiles_x: int,
        tiles_y: int,
        stride: int,
        channel: int,
        channels: int,
        with_transmittance: int,
        parts: int,
        optimizations: int,
    ) -> None: ...

    return blend_backward


# One and three channels are the common cases (depth, colour); four serve colour + depth and wider features.
_WIDTHS = (1, 3, 4)
_FORWARD = {width: _forward(width) for width in _WIDTHS}
_BACKWARD = {(width, absgrad): _backward(width, absgrad) for width in _WIDTHS for absgrad in (False, True)}


def forward_worker(channels: int) -> Worker:
    """The forward kernel that fits `channels` (1 to MAX_CHANNELS) best."""
    return _FORWARD[min(width for width in _WIDTHS if width >= channels)]


def backward_worker(channels: int, absgrad: bool) -> Worker:
    """The backward kernel that fits `channels` (1 to MAX_CHANNELS) best."""
    return _BACKWARD[min(width for width in _WIDTHS if width >= channels), absgrad]


@worker(read_kernel("reduce_pairs.h"), items="(rows + BLOCK - 1) / BLOCK", grain="1", constants={"DENSE": 1})
def reduce_pairs(
    visible: Annotated[IntArray, "M"],
    block_start: Annotated[IntArray, "blocks(rows) + 1"],  # where each block of rows begins in `visible`
    pair_start: Annotated[IntArray, "M + 1"],
    far_visible: Annotated[IntArray, "F"],  # those with pairs in the second part of the lists
    far_block_start: Annotated[IntArray, "blocks(rows) + 1"],
    far_pair_start: Annotated[IntArray, "F + 1"],
    pair_slot: Annotated[IntArray, "P"],
    v_pairs: Annotated[FloatArray, "Q, PAIR"],
    conics: Annotated[FloatArray, "rows, 3"],
    opacities: Annotated[FloatArray, "rows"],
    # Out, zeros where not visible; added to from the second pass over the channels on, as the next.
    v_means2d: Annotated[FloatArray, "rows, 2"],
    v_conics: Annotated[FloatArray, "rows, 3"],
    v_opacities: Annotated[FloatArray, "rows"],
    v_absolute: Annotated[FloatArray, "rows if absgrad else 0, 2"],  # out, added to
    v_colors: Annotated[FloatArray, "rows, stride"],  # out
    rows: int,
    stride: int,
    channel: int,
    channels: int,
    absgrad: int,
    parts: int,
) -> None: ...
