"""The blend of one image from its projected Gaussians, and the adjoint, any number of channels."""

from dataclasses import dataclass

import torch
from torch import Tensor

from .binning import Bins, bin_gaussians, pack_colors
from .blend import backward_worker, forward_worker, reduce_pairs
from .constants import MAX_CHANNELS, PAIR, padded, tiles
from .launch import floats, ints, longs, scratch, zeros
from .shortcuts import active_shortcuts


@dataclass
class Blended:
    """What the adjoint of a blend needs beside its inputs and the transmittance.

    Attributes:
        bins: The lists, sorted as far as the pixels took them.
        block_start: [blocks + 1] int32, where each block of rows begins among the visible ones.
        pixel_stop: [H, W] int32, place in the list behind the last Gaussian blended.
        tile_stop: [tiles] int32, the maximum over each tile.
        pair_blocks: [P] int32, blocks of a tile in which a pair was blended, as bits, by place in the lists.
        blended_pairs: [P, padded] uint8, whether a pair was blended, by its number.
        dense: Whether rows that are not visible get gradients, zeros.
    """

    bins: Bins
    block_start: Tensor
    pixel_stop: Tensor
    tile_stop: Tensor
    pair_blocks: Tensor
    blended_pairs: Tensor
    dense: bool


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
) -> tuple[Tensor, Tensor, Blended]:
    """Image [H, W, D] and the transmittance [H, W] behind it."""
    bins = bin_gaussians(visible, means2d, depths, conics, opacities, sigmas, colors, width, height, dense)
    channels, pairs = colors.shape[1], len(bins.tile_list)
    size = (width, height, *tiles(width, height))
    image, transmittance = floats(height, width, channels), floats(height, width)
    pixel_stop, tile_stop, pair_blocks = ints(height, width), ints(size[2] * size[3]), ints(pairs)
    blended_pairs = zeros(padded(pairs), dtype=torch.uint8)
    in_one = channels <= MAX_CHANNELS
    if not in_one:
        bins.sort()
    buffer = longs(pairs if in_one else 0)
    for channel in range(0, channels, MAX_CHANNELS):
        some = min(MAX_CHANNELS, channels - channel)
        if channel > 0:
            pack_colors(bins.visible, colors, bins.records, len(bins.visible), channels, channel, some)
        forward_worker(some)(
            bins.records, bins.tile_start, bins.pair_row, bins.unsorted, buffer, bins.tile_list, bins.tile_place,
            image, transmittance, pixel_stop, tile_stop, pair_blocks, blended_pairs,
            *size, channels, channel, some, int(not in_one), active_shortcuts(),
        )  # fmt: skip
    bins.unsorted, bins.pair_row = longs(0), ints(0)  # no longer needed
    blended = Blended(bins, block_start, pixel_stop, tile_stop, pair_blocks, blended_pairs, dense)
    return image, transmittance, blended


def blend_adjoint(
    blended: Blended,
    means2d: Tensor,  # [R, 2], as the next ones the inputs of the blend
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    colors: Tensor,  # [R, D]
    transmittance: Tensor,  # [H, W]
    v_image: Tensor,  # [H, W, D]
    v_transmittance: Tensor,  # [H, W]
    absolute: Tensor | None,  # [R, 2]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, conics, opacities and colors; `absolute` receives the sum over pixels of |v_means2d|."""
    bins = blended.bins
    height, width, channels = v_image.shape
    size = (width, height, *tiles(width, height))
    v_image, v_transmittance = v_image.contiguous(), v_transmittance.contiguous()
    v_means2d, v_conics, v_opacities, v_colors = (floats(*t.shape) for t in (means2d, conics, opacities, colors))
    with_absolute = absolute is not None
    absolute = floats(0) if absolute is None else absolute
    pairs = len(bins.tile_list)
    # Behind the surface most pairs are not blended: they have no sums.
    pair_number = blended.blended_pairs[:pairs].cumsum(0, dtype=torch.int32)
    v_pairs = scratch("v_pairs", int(pair_number[-1]) if pairs else 0, PAIR)
    for channel in range(0, channels, MAX_CHANNELS):
        some = min(MAX_CHANNELS, channels - channel)
        if channels > MAX_CHANNELS:
            pack_colors(bins.visible, colors, bins.records, len(bins.visible), channels, channel, some)
        backward_worker(some, with_absolute)(
            bins.records, bins.tile_start, bins.tile_list, bins.tile_place, blended.tile_stop, blended.pair_blocks,
            transmittance, blended.pixel_stop, v_image, v_transmittance, pair_number, v_pairs,
            *size, channels, channel, some, active_shortcuts(),
        )  # fmt: skip
        reduce_pairs(
            bins.visible, blended.block_start, bins.pair_start, pair_number, blended.blended_pairs, v_pairs, conics,
            opacities, v_means2d, v_conics, v_opacities, absolute, v_colors,
            len(means2d), channels, channel, some, int(with_absolute), int(blended.dense),
        )  # fmt: skip
        # The gradient of the transmittance belongs to the first pass alone.
        v_transmittance = torch.zeros_like(v_transmittance) if channels > MAX_CHANNELS else v_transmittance
    return v_means2d, v_conics, v_opacities, v_colors
