"""Constants that Python and the kernels share. The text of every kernel begins with their C++ definitions."""

import math

# Pixels along each side of a tile. gsplat and Inria's rasterizer use the same size. A tile consists of
# patches of 4 x 4 or 4 x 2 pixels (`kernels/lib/blend_tile.h`).
TILE = 16

# Rows (Gaussians) of a block. One thread clears and fills the gradients of one block at a time, about 30 KB without
# SH coefficients, so that they are still in its cache when they are filled. One partial sum of the camera's gradients
# covers one block, so results depend on this number in their last bits.
BLOCK_ROWS = 512

# Floats of a `Record`, the data of a Gaussian that the blend reads: one cache line (`kernels/lib/record.h`).
RECORD_FLOATS = 16

# Ints of a `Footprint`, the tiles of a small Gaussian as bits (`kernels/lib/tile_lists.h`).
FOOTPRINT_INTS = 2

# Ints of a `TileBox`, the box of tiles around a larger Gaussian (`kernels/lib/ellipse.h`): two columns and two rows.
BOX_INTS = 4

# Ints of a `DepthRange`, the depths that a tile lists (`kernels/lib/tile_lists.h`).
DEPTH_RANGE_INTS = 2

# Bits of a depth greater than every finite float's: the largest int.
NO_DEPTH = 2**31 - 1

# Counters of a slice beyond those of its tiles: counting two neighbouring tiles at a time may touch these two.
SPARE_COUNTS = 2

# Floats of a `PairSum`, the part of a Gaussian's gradient from one tile: one cache line (`kernels/lib/record.h`).
PAIR_FLOATS = 16

# Floats of a `TileLoss`, the sums of the loss over one tile (`kernels/loss_tiles.h`).
TILE_LOSS_FLOATS = 2

# Number of SH coefficients of degrees 1 to 3 for each channel: (3 + 1)^2 - 1, all but the constant one.
HIGHER_COEFFICIENTS = 15

# Floats in a row of each factor of a `FactoredGradient`: three of a direction or a colour, and one unused, so that rows
# move as vectors of four.
FACTOR_FLOATS = 4

# Most buckets into which the pairs of a tile are distributed by depth before they are sorted. A tile takes at least two
# buckets per pair up to this number, whose 8192 bucket ends fill a first-level cache of 32 KiB.
MAX_BUCKETS = 8192

# Most channels that one pass blends: a record has room for four. Wider colours take several passes.
MAX_CHANNELS = 4

# Cut-offs of gsplat and Inria's rasterizer, without units. Alpha is clamped at ALPHA_MAX. A contribution with an alpha
# below ALPHA_MIN is dropped. A pixel is finished when the next Gaussian would reduce its transmittance to
# TRANSMITTANCE_MIN or less.
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# Pixels along each side of SSIM's window, as in its paper (Wang et al. 2004) and in all 3DGS trainers.
SSIM_WINDOW = 11

# Most rows of a tile of the loss, and most vectors of 16 floats in each row: 128 rows of 256 floats. The buffers of
# such a tile fit into the first two caches.
LOSS_TILE_ROWS = 128
LOSS_TILE_VECTORS = 16

# Most channels of an image that the loss takes: its buffers have room for the window's reach of 5 pixels on each side.
MAX_LOSS_CHANNELS = 32


def blocks(n: int) -> int:
    """Number of blocks of BLOCK_ROWS rows that hold `n` rows."""
    return -(-n // BLOCK_ROWS)


def tiles(width: int, height: int) -> tuple[int, int]:
    """Numbers of tiles along the width and the height of an image of this size in pixels."""
    return -(-width // TILE), -(-height // TILE)
