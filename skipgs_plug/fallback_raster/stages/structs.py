"""Structs that several kernels share. Their C++ versions have the same names and fields (`runtime/parameters.py`).

Sizes are expressions that `guard.Sizes` checks: `n` is the number of Gaussians, and `blocks(n)` the number of their
blocks of BLOCK_ROWS rows. The gradient of the loss with respect to a quantity has its name with `v_` in front.
"""

from typing import Annotated, NamedTuple, TypeAlias

import torch
from torch import Tensor

from ..runtime.constants import tiles
from ..runtime.parameters import ArrayKind, FloatArray, FloatOutput, IntArray, IntOutput

# C++ expression for the number of blocks, for workers whose items are blocks of the `n` Gaussians.
BLOCKS = "(n + BLOCK_ROWS - 1) / BLOCK_ROWS"

# Arrays of records, whose fields are defined in C++: `Record` and `PairSum` in `kernels/lib/record.h`, the others in
# `kernels/lib/tile_lists.h` and `kernels/lib/ellipse.h`.
RecordArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "const struct Record")]
RecordOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "struct Record")]
PairSumArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "const struct PairSum")]
PairSumOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.float32, "struct PairSum")]
FootprintOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "struct Footprint")]
TileBoxOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "struct TileBox")]
DepthRangeArray: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "const struct DepthRange")]
DepthRangeOutput: TypeAlias = Annotated[Tensor, ArrayKind(torch.int32, "struct DepthRange")]


class Gaussians(NamedTuple):
    """Parameters of Gaussians. With `raw`, scales are logarithms."""

    means: Annotated[FloatArray, "n, 3"]  # world space
    quats: Annotated[FloatArray, "n, 4"]  # w, x, y, z, of any length
    scales: Annotated[FloatArray, "n, 3"]  # standard deviations, world units


class Camera(NamedTuple):
    """A pinhole camera and its low-pass filter."""

    viewmat: Annotated[FloatArray, "4, 4"]  # world to camera
    K: Annotated[FloatArray, "3, 3"]  # intrinsics in pixels
    width: float  # pixels
    height: float  # pixels
    eps2d: float  # added to the 2D covariance's diagonal, square pixels


class Grid(NamedTuple):
    """The size of an image, and its numbers of tiles."""

    width: int  # pixels
    height: int  # pixels
    tiles_x: int
    tiles_y: int


def grid(width: int, height: int) -> Grid:
    """Return the tiles of an image of this size in pixels."""
    return Grid(width, height, *tiles(width, height))


class RowList(NamedTuple):
    """A list of row numbers, ascending, and the start of each block of rows in the list."""

    rows: Annotated[IntArray, "block_start[-1]"]
    block_start: Annotated[IntArray, "blocks(n) + 1"]


class BlockRows(NamedTuple):
    """Rows that a kernel finds in each block, written from the block's first row on, and their number."""

    rows: Annotated[IntOutput, "n"]
    counts: Annotated[IntOutput, "blocks(n)"]


class Splats(NamedTuple):
    """Gaussians on the image plane, which tile lists and blend read."""

    means2d: Annotated[FloatArray, "n, 2"]  # pixels, the first pixel centre at 0.5
    depths: Annotated[FloatArray, "n"]
    conics: Annotated[FloatArray, "n, 3"]  # upper triangle of the inverse 2D covariance
    opacities: Annotated[FloatArray, "n"]  # compensated where antialiased
    sigmas: Annotated[FloatArray, "n, 2"]  # standard deviations along x and y in pixels


class SplatGradients(NamedTuple):
    """Gradients of the splats and colours that the blend reads."""

    means2d: Annotated[FloatOutput, "n, 2"]
    conics: Annotated[FloatOutput, "n, 3"]
    opacities: Annotated[FloatOutput, "n"]
    absolute: Annotated[FloatOutput, "n if absgrad else 0, 2"]  # kernels add the sum over pixels of |v_means2d|
    colors: Annotated[FloatOutput, "n, channels.stride"]


class ProjectedGradients(NamedTuple):
    """Gradients of the outputs of the projection."""

    means2d: Annotated[FloatArray, "n, 2"]
    depths: Annotated[FloatArray, "n if flags.with_depth else 0"]
    conics: Annotated[FloatArray, "n, 3"]
    compensations: Annotated[FloatArray, "n if flags.antialiased else 0"]
    opacities: Annotated[FloatArray, "0"]  # used only by `splat_adjoint`, which passes it inside C++


class ProjectAdjointFlags(NamedTuple):
    """Inputs and outputs that the adjoint of the projection has."""

    with_depth: int  # 1 if the depths have a gradient
    antialiased: int  # 1 if opacities were compensated
    with_pose: int  # 1 to compute the gradient of the camera's pose
    optimizations: int  # bits of `OPTIMIZATIONS`


class GaussianGradients(NamedTuple):
    """Gradients of the parameters of Gaussians."""

    means: Annotated[FloatOutput, "n, 3"]
    quats: Annotated[FloatOutput, "n, 4"]
    scales: Annotated[FloatOutput, "n, 3"]


class Harmonics(NamedTuple):
    """SH coefficients, and the position from which they are evaluated.

    The constant band of Gaussian g begins at index `sh0_stride` * g of `sh0`. Its higher bands begin at index
    `shN_stride` * g + `shN_offset` of `shN`, which may be the same array.
    """

    position: Annotated[FloatArray, "3"]  # of the camera in world space
    sh0: Annotated[FloatArray, "n, sh0_stride"]
    shN: Annotated[FloatArray, "n, shN_stride"]
    sh0_stride: int
    shN_stride: int
    shN_offset: int
    degree: int  # 0 to 3


class HarmonicsGradients(NamedTuple):
    """Gradients of the SH coefficients, in the layout of `Harmonics`."""

    sh0: Annotated[FloatOutput, "n, sh.sh0_stride"]
    # The same array as sh0 if the coefficients share one.
    shN: Annotated[FloatOutput, "0 if factored else n, sh.shN_stride"]
    factored: int  # 1 if a `FactorOutput` receives the gradient of the higher bands instead


class FactorOutput(NamedTuple):
    """Factors of the gradient of the higher bands, in place of `HarmonicsGradients.shN`. See `FactoredGradient`."""

    directions: Annotated[FloatOutput, "sums.M if v_sh.factored and sh.degree else 0, FACTOR_FLOATS"]
    colors: Annotated[FloatOutput, "sums.M if v_sh.factored and sh.degree else 0, FACTOR_FLOATS"]


class Channels(NamedTuple):
    """The channels that one pass over the colours blends."""

    stride: int  # number of all channels
    first: int  # first channel of the pass
    number: int  # channels of the pass, at most MAX_CHANNELS


class PairSums(NamedTuple):
    """Sums of the blended pairs, and the indices with which kernels add up those of each row."""

    rows: Annotated[IntArray, "M"]  # visible Gaussians
    block_start: Annotated[IntArray, "blocks(n) + 1"]  # start of each block of rows among them
    pair_start: Annotated[IntArray, "M + 1"]  # number of the first pair of each row
    # The same three for the lists of the second pass, if there is one.
    far_rows: Annotated[IntArray, "F"]
    far_block_start: Annotated[IntArray, "blocks(n) + 1"]
    far_pair_start: Annotated[IntArray, "F + 1"]
    pair_slot: Annotated[IntArray, "P"]  # 1 + the slot of each pair, 0 if it was not blended
    slots: Annotated[PairSumArray, "Q, PAIR_FLOATS"]
    parts: int  # number of passes over the lists: 1 or 2
