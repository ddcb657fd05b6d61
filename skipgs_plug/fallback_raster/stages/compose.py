"""Composes one image from projected Gaussians, with any number of channels, and computes the adjoint."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..runtime.buffers import floats, ints, longs, scratch, zeros
from ..runtime.constants import MAX_CHANNELS, PAIR_FLOATS
from ..runtime.optimizations import active_optimizations
from .binning import Bins, bin_gaussians
from .blend import (
    ADJOINT,
    FORWARD,
    BackwardPairs,
    BlendedList,
    BlendedPairs,
    FinalPixels,
    ListPart,
    PairSlots,
    PixelGradients,
    Pixels,
    compiled_channels,
    reduce_pairs,
)
from .structs import Channels, PairSums, RowList, SplatGradients, Splats
from .two_pass import bin_behind, near_ranges


@dataclass
class Pass:
    """The tile lists of one pass over an image, and the pairs that it blended.

    Attributes:
        bins: The lists, sorted as far as the pixels needed them.
        block_start: [blocks + 1] int32, start of each block of rows among the visible rows of `bins`.
        blended: The blended pairs, by list index.
    """

    bins: Bins
    block_start: Tensor
    blended: BlendedPairs

    def after(self, near: "Pass") -> "Pass":
        """Return this pass with its pairs joined behind those of `near`, the first pass."""
        first, own, pairs = near.bins, self.bins, len(near.bins.tile_record)
        bins = replace(
            own,
            tile_start=own.tile_start + pairs,
            tile_record=torch.cat([first.tile_record, own.tile_record]),
            tile_pair=torch.cat([first.tile_pair, own.tile_pair + pairs]),
            pairs=own.pairs._replace(start=own.pairs.start + pairs),
        )
        blended = BlendedPairs(
            tile_stop=self.blended.tile_stop + pairs,
            tile_blended=self.blended.tile_blended,
            pair_patches=torch.cat([near.blended.pair_patches, self.blended.pair_patches]),
        )
        return Pass(bins, self.block_start, blended)

    def as_list(self) -> BlendedList:
        """Return the blended part of the lists for the adjoint."""
        return BlendedList(self.bins.packed.records, self.bins.tile_start, self.blended.tile_stop)


@dataclass
class Composed:
    """The state that the adjoint of an image needs besides its inputs and the transmittance.

    Attributes:
        near: The first pass. It is the only one if its lists were deep enough.
        last: The second pass, with the pairs of both passes; `near` if there was none.
        pixel_stop: [H, W] int32, list index behind the last blended Gaussian.
    """

    near: Pass
    last: Pass
    pixel_stop: Tensor

    @property
    def parts(self) -> int:
        """Number of passes: 1 or 2."""
        return 1 if self.last is self.near else 2


def compose(
    splats: Splats,  # R rows
    colors: Tensor,  # [R, D]
    visible: RowList,
    width: int,
    height: int,
    dense: bool = True,
) -> tuple[Tensor, Tensor, Tensor, Composed]:
    """Blend projected Gaussians to one image.

    Args:
        splats: Projected Gaussians. With `dense`, tensors may have a leading dimension of one camera.
        colors: Their colours, any number of channels.
        visible: Rows of the visible Gaussians.
        width: Image width in pixels.
        height: Image height in pixels.
        dense: Whether to return the shapes of `rasterization`, and to count tiles for all rows.

    Returns:
        Image [1, H, W, D], or [H, W, D] without `dense`; transmittance [H, W]; alpha [1, H, W, 1], or empty without
        `dense`; and the state for the adjoint.
    """
    channels = colors.shape[1]
    ranges = near_ranges(visible.rows, splats, width, height) if channels <= MAX_CHANNELS else None
    limited = ranges is not None
    bins = bin_gaussians(visible.rows, splats, colors, width, height, dense, ranges)
    pixels = Pixels(
        image=floats(1, height, width, channels) if dense else floats(height, width, channels),
        transmittance=floats(height, width),
        alpha=floats(1, height, width, 1) if dense else floats(0),
        pixel_stop=ints(height, width),
        product_left=floats(height if limited else 0, width),
        still_open=ints(bins.grid.tiles_x * bins.grid.tiles_y if limited else 0),
    )
    near = last = _blend_lists(bins, visible.block_start, colors, pixels, ListPart(0, 0, int(limited)))
    if ranges is not None:
        behind = bin_behind(bins, ranges, pixels.still_open, visible.block_start, splats, colors)
        if behind is not None:
            part = ListPart(len(bins.tile_record), 1, 0)
            last = _blend_lists(*behind, colors, pixels, part).after(near)
    return pixels.image, pixels.transmittance, pixels.alpha, Composed(near, last, pixels.pixel_stop)


def _passes(channels: int) -> Iterator[Channels]:
    """Divide channels into passes of at most MAX_CHANNELS."""
    for first in range(0, channels, MAX_CHANNELS):
        yield Channels(channels, first, min(MAX_CHANNELS, channels - first))


def _blend_lists(bins: Bins, block_start: Tensor, colors: Tensor, pixels: Pixels, part: ListPart) -> Pass:
    tiles = bins.grid.tiles_x * bins.grid.tiles_y
    blended = BlendedPairs(ints(tiles), ints(tiles), ints(len(bins.tile_record)))
    in_one = colors.shape[1] <= MAX_CHANNELS
    if not in_one:
        bins.sort()
    lists = bins.lists(sorted=not in_one)
    for channels in _passes(colors.shape[1]):
        if channels.first > 0:
            bins.pack_colors(colors, channels)
        FORWARD[compiled_channels(channels.number)](
            records=bins.packed.records,
            lists=lists,
            pixels=pixels,
            blended=blended,
            grid=bins.grid,
            channels=channels,
            part=part,
            with_alpha=int(len(pixels.alpha) > 0),
            optimizations=active_optimizations(),
        )
    bins.pairs = bins.pairs._replace(record=ints(0), unsorted=longs(0))  # no longer needed: free the memory
    return Pass(bins, block_start, blended)


def pair_sums(
    composed: Composed,
    colors: Tensor,  # [R, D], of the forward pass
    transmittance: Tensor,  # H W numbers, of the forward pass
    v_image: Tensor | None,  # H W D numbers; None for zeros
    v_transmittance: Tensor | None,  # H W numbers; None for zeros
    with_absolute: bool,
) -> Iterator[tuple[Channels, PairSums]]:
    """Run the adjoint of the blend. Yields the channels and sums of each pass; sums are valid until the next pass."""
    near, last, parts = composed.near, composed.last, composed.parts
    bins, lists = near.bins, last.bins
    grid, channels = bins.grid, colors.shape[1]
    v_pixels = PixelGradients(
        image=zeros(grid.height, grid.width, channels) if v_image is None else v_image.contiguous(),
        transmittance=floats(0, grid.width) if v_transmittance is None else v_transmittance.contiguous(),
    )
    # Most pairs behind a surface are not blended, and have no slot.
    per_tile = near.blended.tile_blended
    if parts > 1:
        per_tile = torch.cat([per_tile, last.blended.tile_blended])
    slot_end = per_tile.cumsum(0, dtype=torch.int32)
    pairs = BackwardPairs(lists.tile_record, lists.tile_pair, last.blended.pair_patches, slot_end, parts)
    slots = PairSlots(
        pair_slot=zeros(len(lists.tile_record), dtype=torch.int32),
        sums=scratch("pair_sums", int(slot_end[-1]), PAIR_FLOATS),
    )
    sums = PairSums(
        rows=bins.visible,
        block_start=near.block_start,
        pair_start=bins.pairs.start,
        far_rows=lists.visible,
        far_block_start=last.block_start,
        far_pair_start=lists.pairs.start,
        pair_slot=slots.pair_slot,
        slots=slots.sums,
        parts=parts,
    )
    for some in _passes(channels):
        if channels > MAX_CHANNELS:
            bins.pack_colors(colors, some)
        ADJOINT[compiled_channels(some.number), with_absolute](
            near=near.as_list(),
            far=last.as_list(),
            pairs=pairs,
            pixels=FinalPixels(transmittance, composed.pixel_stop),
            v_pixels=v_pixels,
            slots=slots,
            grid=grid,
            channels=some,
            with_transmittance=int(len(v_pixels.transmittance) > 0),
            optimizations=active_optimizations(),
        )
        yield some, sums
        # Only the first pass adds the gradient of the transmittance.
        v_pixels = v_pixels._replace(transmittance=floats(0, grid.width))


def compose_adjoint(
    composed: Composed,
    # Inputs of `compose`:
    means2d: Tensor,  # [R, 2]
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    colors: Tensor,  # [R, D]
    # Outputs of `compose`, and their gradients:
    transmittance: Tensor,  # H W numbers
    v_image: Tensor | None,  # H W D numbers; None for zeros
    v_transmittance: Tensor | None,  # H W numbers; None for zeros
    absolute: Tensor | None,  # [R, 2]
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return gradients of means2d, conics, opacities and colors. Adds sums over pixels of |v_means2d| to `absolute`."""
    with_absolute = absolute is not None
    v_splats = SplatGradients(
        means2d=floats(*means2d.shape),
        conics=floats(*conics.shape),
        opacities=floats(*opacities.shape),
        absolute=floats(0) if absolute is None else absolute,
        colors=floats(*colors.shape),
    )
    for channels, sums in pair_sums(composed, colors, transmittance, v_image, v_transmittance, with_absolute):
        reduce_pairs(
            sums=sums,
            conics=conics,
            opacities=opacities,
            v_splats=v_splats,
            n=len(colors),
            channels=channels,
            absgrad=int(with_absolute),
        )
    return v_splats.means2d, v_splats.conics, v_splats.opacities, v_splats.colors
