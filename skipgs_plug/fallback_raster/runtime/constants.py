"""Numbers that Python and the kernels share; the text of every kernel gets them by name."""

import math

# Pixels along the side of a tile, which is blocks of 4 x 4 or 4 x 2 pixels (`kernels/lib/blend_tile.h`).
TILE = 16

# Rows that one core clears and fills at a time, and that one partial sum of the camera's gradients covers.
BLOCK = 512

# Floats of a Gaussian as the blend reads it: centre x, y; the conic as a sum of squares, so that with
# p = r[2] dx + r[3] dy and w = r[4] dy, alpha = exp2(r[5] - p^2 - w^2); half height and half width in pixels of the
# ellipse at ALPHA_MIN; up to four channels of colour; where p^2 + w^2 is least, dx / dy along a row and dy / dx along a
# column; p^2 + w^2 at ALPHA_MIN; 1 / r[2]. Together a cache line.
RECORD = 16

# Numbers of the place of a Gaussian among the tiles: the first tile of the box around it, and which of its tiles it
# meets, as bits, where they are few (`kernels/lib/box_tiles.h`); -1 where they are more.
PLACE = 2

# Numbers of the box of tiles around a larger one: its first and last column, its first and last row.
BOX = 4

# Counters of a slice that belong to no tile, so that tiles can be counted two at a time.
SPARE_COUNTS = 2

# Sums of a (tile, Gaussian) pair in the adjoint: the six moments; up to four channels of colour; |v_x|, |v_y|; the rest
# makes it a cache line.
PAIR = 16

# Bands of SH of degree 3 beside the constant one.
BANDS = 15

# Numbers of a row of either factor of an `FactoredGradient`: of a direction or a colour, and one that nobody reads.
FACTOR = 4

# Most ranges of depth into which a tile deals its pairs before it sorts one after the other.
BUCKETS = 8192

# Channels that one pass blends; wider colours take several passes.
MAX_CHANNELS = 4

# Cut-offs of gsplat and of Inria's rasterizer: alpha is clamped at the first, a contribution under the second is
# dropped, and a pixel is finished when the next Gaussian would bring its transmittance to the third or less.
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# The loss: pixels of the window of SSIM; rows and vectors of 16 floats of a tile; channels that the buffers which
# extend a row beyond the image have room for.
WINDOW = 11
BAND = 128
CHUNK = 16
LOSS_CHANNELS = 32


def blocks(n: int) -> int:
    """Blocks of rows that `n` rows make."""
    return -(-n // BLOCK)


def tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles along the sides of an image."""
    return -(-width // TILE), -(-height // TILE)
