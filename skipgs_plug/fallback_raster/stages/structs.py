"""Structs that several kernels share; in C++ they have the same names and fields (`runtime/parameters.py`).

Sizes are expressions as `guard.Sizes` checks them: `n` is the number of Gaussians, `blocks(n)` that of their blocks of
BLOCK rows. A gradient of the loss is named after what it belongs to, `v_` in front.
"""

from typing import Annotated, NamedTuple

from ..runtime.constants import tiles
from ..runtime.parameters import FloatArray, FloatOutput, IntArray, IntOutput


class Gaussians(NamedTuple):
    """Parameters of Gaussians; where `raw`, scales are logarithms."""

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
    """An image and its tiles."""

    width: int  # pixels
    height: int  # pixels
    tiles_x: int
    tiles_y: int


def grid(width: int, height: int) -> Grid:
    """The tiles of an image of this size in pixels."""
    return Grid(width, height, *tiles(width, height))


class RowList(NamedTuple):
    """Some rows, ascending, and where each block of rows begins among them."""

    rows: Annotated[IntArray, "block_start[-1]"]
    block_start: Annotated[IntArray, "blocks(n) + 1"]


class BlockRows(NamedTuple):
    """Rows that a kernel finds in each block, from where the block begins, and their number."""

    rows: Annotated[IntOutput, "n"]
    counts: Annotated[IntOutput, "blocks(n)"]


class Splats(NamedTuple):
    """Gaussians on the image plane, as tile lists and blend read them."""

    means2d: Annotated[FloatArray, "n, 2"]  # pixels, the first pixel centre at 0.5
    depths: Annotated[FloatArray, "n"]
    conics: Annotated[FloatArray, "n, 3"]  # upper triangle of the inverse 2D covariance
    opacities: Annotated[FloatArray, "n"]  # compensated where antialiased
    sigmas: Annotated[FloatArray, "n, 2"]  # standard deviations along x and y in pixels


class SplatGradients(NamedTuple):
    """Gradients of what the blend reads of each Gaussian."""

    means2d: Annotated[FloatOutput, "n, 2"]
    conics: Annotated[FloatOutput, "n, 3"]
    opacities: Annotated[FloatOutput, "n"]
    absolute: Annotated[FloatOutput, "n if absgrad else 0, 2"]  # |v_means2d| summed over pixels, added to
    colors: Annotated[FloatOutput, "n, channels.stride"]


class ProjectedGradients(NamedTuple):
    """Gradients of what the projection gives."""

    means2d: Annotated[FloatArray, "n, 2"]
    depths: Annotated[FloatArray, "n if with_depth else 0"]
    conics: Annotated[FloatArray, "n, 3"]
    compensations: Annotated[FloatArray, "n if antialiased else 0"]
    opacities: Annotated[FloatArray, "0"]  # of raw parameters, which only `splat_adjoint` has


class GaussianGradients(NamedTuple):
    """Gradients of the parameters of Gaussians."""

    means: Annotated[FloatOutput, "n, 3"]
    quats: Annotated[FloatOutput, "n, 4"]
    scales: Annotated[FloatOutput, "n, 3"]


class Harmonics(NamedTuple):
    """SH coefficients and the position that they are seen from.

    The constant band of Gaussian g lies at `sh0_stride` g of `sh0`, the others at `shN_stride` g + `shN_offset` of
    `shN`, which may be the same array.
    """

    position: Annotated[FloatArray, "3"]  # of the camera in world space
    sh0: Annotated[FloatArray, "n, sh0_stride"]
    shN: Annotated[FloatArray, "n, shN_stride"]
    sh0_stride: int
    shN_stride: int
    shN_offset: int
    degree: int  # 0 to 3


class HarmonicsGradients(NamedTuple):
    """Gradients of the coefficients, in their layout."""

    sh0: Annotated[FloatOutput, "n, sh.sh0_stride"]
    shN: Annotated[FloatOutput, "0 if factored else n, sh.shN_stride"]  # sh0 itself where both are one array
    factored: int  # whether a `FactorOutput` gets the gradient of the higher bands instead


class FactorOutput(NamedTuple):
    """The gradient of the higher bands in factors, in place of `HarmonicsGradients.shN`; see `FactoredGradient`."""

    directions: Annotated[FloatOutput, "sums.M if v_sh.factored and sh.degree else 0, FACTOR"]
    colors: Annotated[FloatOutput, "sums.M if v_sh.factored and sh.degree else 0, FACTOR"]


class Channels(NamedTuple):
    """Channels of one pass over the colours."""

    stride: int  # all there are
    first: int
    number: int  # at most MAX_CHANNELS


class PairSums(NamedTuple):
    """Sums of the pairs that were blended, as kernels read them that add up those of a row."""

    rows: Annotated[IntArray, "M"]  # visible Gaussians
    block_start: Annotated[IntArray, "blocks(n) + 1"]  # where each block of rows begins among them
    pair_start: Annotated[IntArray, "M + 1"]  # number of the first pair of each
    # The same three of the second part of the lists, if there is one.
    far_rows: Annotated[IntArray, "F"]
    far_block_start: Annotated[IntArray, "blocks(n) + 1"]
    far_pair_start: Annotated[IntArray, "F + 1"]
    pair_slot: Annotated[IntArray, "P"]  # 1 + the slot of each pair, 0 if it was not blended
    slots: Annotated[FloatArray, "Q, PAIR"]  # a `PairSum` each
