"""Numbers that Python and the kernels share; the text of every kernel gets them by name."""

import math

# Pixels along the side of a tile, as in gsplat and Inria's rasterizer. A tile is patches of 4 x 4 or 4 x 2 pixels
# (`kernels/lib/blend_tile.h`).
TILE = 16

# Rows of a block: Gaussians whose gradients one core clears and fills at a time, so that they are still in its cache
# when they are filled, and which one partial sum of the camera's gradients covers.
BLOCK = 512

# Floats of a `Record`: a Gaussian as the blend reads it, one cache line (`kernels/lib/record.h`).
RECORD = 16

# Ints of a Gaussian's footprint on the tiles: the first tile of the box around it, and which tiles of the box it meets,
# as bits, where these are few (`kernels/lib/tile_lists.h`); -1 where they are more.
FOOTPRINT = 2

# Ints of a `TileBox`, the box of tiles around a larger Gaussian (`kernels/lib/ellipse.h`).
BOX = 4

# Counters of a slice that belong to no tile: tiles are counted two at a time, the last of them with one of these.
SPARE_COUNTS = 2

# Floats of a `PairSum`: what one tile adds to a Gaussian's gradient, one cache line (`kernels/lib/record.h`).
PAIR = 16

# Bands of SH of degree 3 beside the constant one.
BANDS = 15

# Floats of a row of either factor of a `FactoredGradient`: three of a direction or a colour, and one that nobody reads,
# so that rows move as vectors.
FACTOR = 4

# Buckets of equal ranges of depth into which a tile deals its pairs at most before it sorts them. It takes two for each
# pair; the ends of 8192 fill a first-level cache of 32 KiB.
BUCKETS = 8192

# Channels that one pass blends, the room for colours in a record; wider colours take several passes.
MAX_CHANNELS = 4

# Cut-offs of gsplat and of Inria's rasterizer: alpha is clamped at the first, a contribution under the second is
# dropped, and a pixel is finished when the next Gaussian would bring its transmittance to the third or less.
ALPHA_MAX = 0.999
ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4
LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)

# Pixels along the side of SSIM's window, as in its paper and in all trainers.
WINDOW = 11

# Rows, and vectors of 16 floats in a row, of a tile of the loss at most. Its buffers stay in the first two caches.
LOSS_ROWS = 128
LOSS_VECTORS = 16

# Most channels of an image that the loss takes: its buffers have room for a window of as many beside a tile.
LOSS_CHANNELS = 32


def blocks(n: int) -> int:
    """Blocks of rows that `n` rows make."""
    return -(-n // BLOCK)


def tiles(width: int, height: int) -> tuple[int, int]:
    """Tiles along the sides of an image."""
    return -(-width // TILE), -(-height // TILE)
