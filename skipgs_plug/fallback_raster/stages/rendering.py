"""The blend of one image from its projected Gaussians, and the adjoint, any number of channels."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints, longs, scratch, zeros
from ..runtime.constants import MAX_CHANNELS, PAIR, tiles
from ..runtime.optimizations import active_optimizations
from .binning import Bins, bin_gaussians
from .blend import backward_worker, forward_worker, reduce_pairs
from .two_pass import bin_the_rest, near_ranges


@dataclass
class Pass:
    """Lists of one image, and what of them was blended.

    Attributes:
        bins: The lists, sorted as far as the pixels took them.
        block_start: [blocks + 1] int32, where each block of rows begins among those of `bins`.
        tile_stop: [tiles] int32, place in the list behind the last Gaussian that a pixel of the tile took.
        tile_blended: [tiles] int32, pairs of the tile that were blended.
        pair_blocks: [P] int32, blocks of a tile in which a pair was blended, as bits, by place in the lists.
    """

    bins: Bins
    block_start: Tensor
    tile_stop: Tensor
    tile_blended: Tensor
    pair_blocks: Tensor

    def after(self, near: "Pass") -> "Pass":
        """This one as the second part of one list of pairs whose first part is `near`."""
        first, own, pairs = near.bins, self.bins, len(near.bins.tile_list)
        bins = replace(
            own,
            tile_start=own.tile_start + pairs,
            tile_list=torch.cat([first.tile_list, own.tile_list]),
            tile_place=torch.cat([first.tile_place, own.tile_place + pairs]),
            pair_start=own.pair_start + pairs,
        )
        pair_blocks = torch.cat([near.pair_blocks, self.pair_blocks])
        return Pass(bins, self.block_start, self.tile_stop + pairs, self.tile_blended, pair_blocks)


@dataclass
class Blended:
    """What the adjoint of a blend needs beside its inputs and the transmittance.

    Attributes:
        near: The lists that were blended first, all there are if they were deep enough.
        last: Those behind them, with the pairs of both; else `near`.
        pixel_stop: [H, W] int32, place in the list behind the last Gaussian blended.
    """

    near: Pass
    last: Pass
    pixel_stop: Tensor

    @property
    def parts(self) -> int:
        """Of the lists: 1 or 2."""
        return 1 if self.last is self.near else 2


def blend(
    means2d: Tensor,  # [R, 2]
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    colors: Tensor,  # [R, D]
    depths: Tensor,  # [R]
    sigmas: Tensor,  # [R, 2]
    visible: Tensor,  # [M]
    block_start: Tensor,  # [blocks + 1]
    width: int,
    height: int,
    dense: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Blended]:
    """Image, the transmittance behind it [H, W], and alpha.

    Where `dense`, image and alpha are [1, H, W, D] and [1, H, W, 1], tiles are counted for all rows, and tensors of
    rows may have a dimension of one camera in front; else the image is [H, W, D], and alpha is left out.
    """
    channels, size = colors.shape[1], (width, height, *tiles(width, height))
    ranges = None
    if channels <= MAX_CHANNELS:
        ranges = near_ranges(visible, means2d, depths, conics, opacities, width, height)
    rows = means2d, depths, conics, opacities, sigmas, colors, width, height
    bins = bin_gaussians(visible, *rows, dense, ranges)
    image = floats(1, height, width, channels) if dense else floats(height, width, channels)
    alpha = floats(1, height, width, 1) if dense else floats(0)
    transmittance, pixel_stop = floats(height, width), ints(height, width)
    limited = ranges is not None
    product_left, still_open = floats(height if limited else 0, width), ints(size[2] * size[3] if limited else 0)
    pixels = image, transmittance, alpha, pixel_stop, product_left, still_open

    near = _blend_lists(bins, block_start, colors, pixels, size, 0, False, limited)
    last = near
    if ranges is not None:
        rest = bin_the_rest(bins, ranges, still_open, block_start, *rows)
        if rest is not None:
            last = _blend_lists(*rest, colors, pixels, size, len(bins.tile_list), True, False).after(near)
    return image, transmittance, alpha, Blended(near, last, pixel_stop)


def _blend_lists(
    bins: Bins,
    block_start: Tensor,
    colors: Tensor,
    pixels: tuple[Tensor, ...],
    size: tuple[int, int, int, int],
    before: int,  # pairs in front of these lists
    continued: bool,  # whether others were blended
    unfinished: bool,  # whether others may follow
) -> Pass:
    channels, pairs = colors.shape[1], len(bins.tile_list)
    image, transmittance, alpha, pixel_stop, product_left, still_open = pixels
    tile_stop, tile_blended, pair_blocks = ints(size[2] * size[3]), ints(size[2] * size[3]), ints(pairs)
    in_one = channels <= MAX_CHANNELS
    if not in_one:
        bins.sort()
    buffer = longs(pairs if in_one else 0)
    for channel in range(0, channels, MAX_CHANNELS):
        some = min(MAX_CHANNELS, channels - channel)
        if channel > 0:
            bins.pack_colors(colors, channel, some)
        forward_worker(some)(
            bins.records, bins.tile_start, bins.pair_record, bins.unsorted, buffer, bins.tile_list, bins.tile_place,
            image, transmittance, alpha, pixel_stop, tile_stop, tile_blended, pair_blocks, product_left, still_open,
            *size, channels, channel, some, int(not in_one), before, int(continued), int(unfinished),
            int(len(alpha) > 0), active_optimizations(),
        )  # fmt: skip
    bins.unsorted, bins.pair_record = longs(0), ints(0)  # no longer needed
    return Pass(bins, block_start, tile_stop, tile_blended, pair_blocks)


class PairSums(NamedTuple):
    """Sums of the pairs that were blended, as kernels read them that add up those of a row.

    Attributes:
        visible: [M] int32, rows.
        block_start: [blocks + 1] int32, where each block of rows begins among them.
        pair_start: [M + 1] int32, number of the first pair of each.
        far_visible: [F] int32, as the next two of the second part of the lists, if there is one.
        far_block_start: [blocks + 1] int32.
        far_pair_start: [F + 1] int32.
        pair_slot: [P] int32, 1 + the slot of each pair, 0 if it was not blended.
        v_pairs: [Q, PAIR], the slots.
    """

    visible: Tensor
    block_start: Tensor
    pair_start: Tensor
    far_visible: Tensor
    far_block_start: Tensor
    far_pair_start: Tensor
    pair_slot: Tensor
    v_pairs: Tensor


def pair_sums(
    blended: Blended,
    colors: Tensor,  # [R, D], as the next one of the forward pass
    transmittance: Tensor,  # H W numbers
    v_image: Tensor | None,  # H W D numbers, None for zeros, as the next
    v_transmittance: Tensor | None,  # H W numbers
    with_absolute: bool,
) -> Iterator[tuple[int, int, PairSums]]:
    """First channel, number of channels and sums of each pass of the adjoint; sums live until the next one."""
    near, last = blended.near, blended.last
    bins, lists, parts = near.bins, last.bins, blended.parts
    (height, width), channels = blended.pixel_stop.shape, colors.shape[1]
    size = (width, height, *tiles(width, height))
    v_image = zeros(height, width, channels) if v_image is None else v_image.contiguous()
    v_transmittance = floats(0, width) if v_transmittance is None else v_transmittance.contiguous()
    # Behind the surface most pairs are not blended: they have no sums.
    per_tile = near.tile_blended if parts == 1 else torch.cat([near.tile_blended, last.tile_blended])
    slot_end = per_tile.cumsum(0, dtype=torch.int32)
    pair_slot = zeros(len(lists.tile_list), dtype=torch.int32)
    v_pairs = scratch("v_pairs", int(slot_end[-1]), PAIR)
    sums = PairSums(
        bins.visible, near.block_start, bins.pair_start, lists.visible, last.block_start, lists.pair_start,
        pair_slot, v_pairs,
    )  # fmt: skip
    for channel in range(0, channels, MAX_CHANNELS):
        some = min(MAX_CHANNELS, channels - channel)
        if channels > MAX_CHANNELS:
            bins.pack_colors(colors, channel, some)
        backward_worker(some, with_absolute)(
            bins.records, bins.tile_start, near.tile_stop, lists.records, lists.tile_start, last.tile_stop,
            lists.tile_list, lists.tile_place, last.pair_blocks, slot_end, transmittance, blended.pixel_stop,
            v_image, v_transmittance, pair_slot, v_pairs,
            *size, channels, channel, some, int(len(v_transmittance) > 0), parts, active_optimizations(),
        )  # fmt: skip
        yield channel, some, sums
        # The gradient of the transmittance belongs to the first pass alone.
        v_transmittance = floats(0, width)


def blend_adjoint(
    blended: Blended,
    means2d: Tensor,  # [R, 2], as the next ones the inputs of the blend
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    colors: Tensor,  # [R, D]
    transmittance: Tensor,  # H W numbers
    v_image: Tensor | None,  # H W D numbers, None for zeros, as the next
    v_transmittance: Tensor | None,  # H W numbers
    absolute: Tensor | None,  # [R, 2]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities and colors; `absolute` receives the sum over pixels of |v_means2d|."""
    v_means2d, v_conics, v_opacities, v_colors = (floats(*t.shape) for t in (means2d, conics, opacities, colors))
    with_absolute = absolute is not None
    absolute = floats(0) if absolute is None else absolute
    for channel, some, sums in pair_sums(blended, colors, transmittance, v_image, v_transmittance, with_absolute):
        reduce_pairs(
            *sums, conics, opacities, v_means2d, v_conics, v_opacities, absolute, v_colors,
            *colors.shape, channel, some, int(with_absolute), blended.parts,
        )  # fmt: skip
    return v_means2d, v_conics, v_opacities, v_colors
