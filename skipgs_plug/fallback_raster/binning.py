"""Which Gaussians touch which tile, front to back.

Gaussians are sorted by depth once (N keys instead of one key per tile pair) and then counted into tiles in that
order, so every tile's list comes out sorted and equal depths keep the order of the input. A tile is listed only
where the ellipse at alpha = 1/255 really crosses it (exact bounds per row of tiles).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from .launch import FloatArray, IntArray, get_num_threads, worker
from .shortcuts import active_shortcuts

TILE = 16

# Floats of a Gaussian as the blend reads it: centre x, y; the conic as a sum of squares, so that with
# p = r[2] dx + r[3] dy and w = r[4] dy, alpha = exp2(r[5] - p^2 - w^2); half height and half width in pixels of the
# ellipse at alpha = 1/255; up to four channels of colour; where p^2 + w^2 is least, dx / dy along a row and dy / dx
# along a column; p^2 + w^2 at alpha = 1/255; one unused, which makes it a cache line.
RECORD = 16

# Channels that one pass blends; wider colours take several passes.
MAX_CHANNELS = 4

# Tiles [left, right] of tile row `ty` that the Gaussian at place `i` crosses.
_TILE_ROWS = """
    const int g = order[i];
    // Depth order is no order of rows: every record is far from the last.
    __builtin_prefetch(records + 16ll * order[smaller(i + 16, n - 1)]);
    const float* r = records + 16ll * g;
    const float mx = r[0], my = r[1], half_h = r[6], half_w = r[7];
    // Rows and columns of pixels whose centres the bounding box holds.
    const int top = (int)ceilf(fmaxf(my - half_h - 0.5f, 0.0f));
    const int bottom = (int)floorf(fminf(my + half_h - 0.5f, height - 1.0f));
    const int box_left = (int)ceilf(fmaxf(mx - half_w - 0.5f, 0.0f));
    const int box_right = (int)floorf(fminf(mx + half_w - 0.5f, width - 1.0f));
    const bool empty = top > bottom || box_left > box_right;
    const int first_row = top / 16, last_row = empty ? first_row - 1 : bottom / 16;
    // Small ones need no more than their bounding box.
    const bool whole = box_left / 16 == box_right / 16 || first_row == last_row || !(shortcuts & 1);
    // The ellipse's edges: x(dy) = mx + dy slope +- chord sqrt(1 - (dy / half_h)^2), farthest out at dy = -+extreme.
    const float slope = r[12], extreme = r[13] * half_w;
    const float inverse_h = whole ? 0.0f : 1.0f / half_h, chord = whole ? 0.0f : sqrtf(fmaxf(r[14], 0.0f)) / r[2];
    auto columns = [&](int ty, int& left, int& right) {
        left = box_left / 16;
        right = box_right / 16;
        if (whole) return;
        const float low = fmaxf(16.0f * ty + 0.5f - my, -half_h), high = fminf(16.0f * ty + 15.5f - my, half_h);
        auto edge = [&](float dy, float side) {
            const float t = dy * inverse_h;
            return mx + dy * slope + side * chord * sqrtf(fmaxf(1.0f - t * t, 0.0f));
        };
        const float x0 = edge(fminf(fmaxf(-extreme, low), high), -1.0f) - 0.51f;
        const float x1 = edge(fminf(fmaxf(extreme, low), high), 1.0f) - 0.49f;
        left = larger(left, (int)floorf(fmaxf(ceilf(x0), 0.0f)) / 16);
        right = smaller(right, x1 < 0.0f ? -1 : (int)floorf(fminf(x1, width - 1.0f)) / 16);
    };
"""


# Least significant digit first, 11 bits at a time; depths are positive, so their bits sort like integers.
_SORT = """
    for (int i = 0; i < n; ++i) {
        keys[i] = ((const int*)depths)[visible[i]];
        values[i] = visible[i];
    }
    int histogram[2048];
    for (int shift = 0; shift < 33; shift += 11) {
        const int* from_keys = shift == 11 ? keys + n : keys;
        const int* from_values = shift == 11 ? values + n : values;
        int* to_keys = shift == 11 ? keys : keys + n;
        int* to_values = shift == 11 ? values : values + n;
        for (int b = 0; b < 2048; ++b) histogram[b] = 0;
        for (int i = 0; i < n; ++i) ++histogram[((unsigned)from_keys[i] >> shift) & 2047];
        int start = 0;
        for (int b = 0; b < 2048; ++b) {
            const int count = histogram[b];
            histogram[b] = start;
            start += count;
        }
        for (int i = 0; i < n; ++i) {
            const int slot = histogram[((unsigned)from_keys[i] >> shift) & 2047]++;
            to_keys[slot] = from_keys[i];
            to_values[slot] = from_values[i];
        }
    }
"""

# Records of the visible rows `i` to `i + 15`.
_PACK = """
        const int lanes = n - i < 16 ? n - i : 16;
        int row[16];
        for (int l = 0; l < 16; ++l) row[l] = visible[i + (l < lanes ? l : lanes - 1)];
        const float log2e = 1.44269504f;
        v16 a = gather(conics, row, 3, 0), b = gather(conics, row, 3, 1), c = gather(conics, row, 3, 2);
        v16 log2_opacity = log2(vmax(gather(opacities, row, 1, 0), (v16)1e-20f));
        v16 reach = log2_opacity + 7.99435344f;
        // a dx^2 + 2 b dx dy + c dy^2 = a (dx + b / a dy)^2 + dy^2 / sigma_y^2: no needle rounds to a negative value.
        v16 along = vsqrt(0.5f * log2e * a), across = vsqrt((v16)(0.5f * log2e)) / gather(sigmas, row, 2, 1);
        // Half axes of the box around alpha >= 1/255, a hair wider than exact: the blend tests every pixel itself.
        v16 half = vsqrt(vmax(2.0f * reach / log2e, (v16)0.0f)) * 1.0001f + 1e-3f;
        v16 value[16] = {
            gather(means2d, row, 2, 0), gather(means2d, row, 2, 1), along, along * (b / a), across, log2_opacity,
            half * gather(sigmas, row, 2, 1), half * gather(sigmas, row, 2, 0), {}, {}, {}, {}, -b / a, -b / c, reach};
        for (int k = 0; k < channels; ++k) value[8 + k] = gather(colors, row, stride, k);
        transpose(value);
        for (int l = 0; l < lanes; ++l) store(records + 16ll * row[l], value[l]);
"""


# One core sorts while the others pack.
@worker(
    """
for (int item = first; item < last; ++item) {
    if (item == 0) {
"""
    + _SORT
    + """
    }
    const int begin = 512 * (item - 1);
    for (int i = begin; item > 0 && i < smaller(begin + 512, n); i += 16) {
"""
    + _PACK
    + """
    }
}
""",
    items="1 + (n + 511) / 512",
    grain=1,
)
def sort_and_pack(
    depths: FloatArray,  # [R]
    visible: IntArray,  # [M]
    keys: IntArray,  # scratch [2M]
    values: IntArray,  # out [2M], the rows front to back in its second half
    means2d: FloatArray,  # [R, 2]
    conics: FloatArray,  # [R, 3]
    opacities: FloatArray,  # [R]
    sigmas: FloatArray,  # [R, 2]
    colors: FloatArray,  # [R, D]
    records: FloatArray,  # out [R, RECORD], only visible rows are written
    n: int,
    stride: int,  # D
    channels: int,
) -> None: ...


@worker(
    """
for (int i = first; i < last; ++i)
    for (int k = 0; k < channels; ++k)
        records[16ll * visible[i] + 8 + k] = colors[(long long)visible[i] * stride + channel + k];
""",
    items="n",
    grain=512,
)
def pack_colors(
    visible: IntArray,  # [M]
    colors: FloatArray,  # [R, D]
    records: FloatArray,  # [R, RECORD], the channels are replaced
    n: int,
    stride: int,  # D
    channel: int,
    channels: int,
) -> None: ...


@worker(
    """
for (int s = first; s < last; ++s) {
    int* count = counts + s * (tiles_x * tiles_y);
    for (int t = 0; t < tiles_x * tiles_y; ++t) count[t] = 0;
    for (int i = (long long)s * n / slices; i < (long long)(s + 1) * n / slices; ++i) {
"""
    + _TILE_ROWS
    + """
        int pairs = 0;
        for (int ty = first_row; ty <= last_row; ++ty) {
            int left, right;
            columns(ty, left, right);
            for (int tx = left; tx <= right; ++tx) ++count[ty * tiles_x + tx];
            if (right >= left) pairs += right - left + 1;
        }
        tiles_per_gauss[g] = pairs;
    }
}
""",
    items="slices",
    grain=1,
)
def count_pairs(
    order: IntArray,  # [M]
    records: FloatArray,  # [R, RECORD]
    counts: IntArray,  # out [slices, tiles]
    tiles_per_gauss: IntArray,  # out [R], zeros
    n: int,
    slices: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
    shortcuts: int,
) -> None: ...


@worker(
    """
int total = 0;
for (int t = 0; t < tiles; ++t) {
    tile_start[t] = total;
    for (int s = 0; s < slices; ++s) {
        const int count = counts[s * tiles + t];
        counts[s * tiles + t] = total;
        total += count;
    }
}
tile_start[tiles] = total;
pair_start[0] = 0;
for (int g = 0; g < n; ++g) pair_start[g + 1] = pair_start[g] + tiles_per_gauss[g];
""",
    items="1",
    grain=1,
)
def scan_pairs(
    counts: IntArray,  # [slices, tiles], in: counts; out: where each slice starts in each tile's list
    tile_start: IntArray,  # out [tiles + 1]
    tiles_per_gauss: IntArray,  # [R]
    pair_start: IntArray,  # out [R + 1], running sum
    n: int,
    slices: int,
    tiles: int,
) -> None: ...


@worker(
    """
for (int s = first; s < last; ++s) {
    int* next = counts + s * (tiles_x * tiles_y);
    for (int i = (long long)s * n / slices; i < (long long)(s + 1) * n / slices; ++i) {
"""
    + _TILE_ROWS
    + """
        int pair = pair_start[g];
        for (int ty = first_row; ty <= last_row; ++ty) {
            int left, right;
            columns(ty, left, right);
            for (int tx = left; tx <= right; ++tx) {
                const int slot = next[ty * tiles_x + tx]++;
                tile_list[slot] = g;
                pair_slot[pair++] = slot;
            }
        }
    }
}
""",
    items="slices",
    grain=1,
)
def fill_pairs(
    order: IntArray,  # [M]
    records: FloatArray,  # [R, RECORD]
    counts: IntArray,  # [slices, tiles], next free place
    pair_start: IntArray,  # [R + 1]
    tile_list: IntArray,  # out [P], rows
    pair_slot: IntArray,  # out [P], for each Gaussian its places in tile_list
    n: int,
    slices: int,
    width: float,
    height: float,
    tiles_x: int,
    tiles_y: int,
    shortcuts: int,
) -> None: ...


@dataclass
class Bins:
    """Tile lists of one image.

    Attributes:
        visible: [M] int32, rows of the visible Gaussians.
        records: [R, RECORD] float32, what the blend reads of each of them.
        tile_start: [tiles + 1] int32, begin of each tile's part of `tile_list`, row-major.
        tile_list: [P] int32, rows, front to back in every tile.
        pair_start: [R + 1] int32, begin of each row's part of `pair_slot`.
        pair_slot: [P] int32, places in `tile_list`.
        tiles_per_gauss: [R] int32, number of tiles of every row.
    """

    visible: Tensor
    records: Tensor
    tile_start: Tensor
    tile_list: Tensor
    pair_start: Tensor
    pair_slot: Tensor
    tiles_per_gauss: Tensor


def bin_gaussians(
    visible: Tensor,  # [M] int32
    means2d: Tensor,  # [R, 2]
    depths: Tensor,  # [R]
    conics: Tensor,  # [R, 3]
    opacities: Tensor,  # [R]
    sigmas: Tensor,  # [R, 2]
    colors: Tensor,  # [R, D]
    width: int,
    height: int,
) -> Bins:
    """Sorts the visible Gaussians of one image by depth and lists them per tile, with their first channels."""
    n = visible.numel()
    tiles_x, tiles_y = (width + TILE - 1) // TILE, (height + TILE - 1) // TILE
    tiles = tiles_x * tiles_y
    rows, channels = colors.shape
    keys, values = torch.empty(2, 2 * n, dtype=torch.int32)
    records = torch.empty(rows, RECORD)
    sort_and_pack(
        depths, visible, keys, values, means2d, conics, opacities, sigmas, colors, records,
        n, channels, min(channels, MAX_CHANNELS),
    )  # fmt: skip
    order = values[n:]

    # Any number of slices gives the same lists; one per thread keeps all busy.
    slices = 1 if n < 1024 else get_num_threads()
    counts = torch.empty(slices, tiles, dtype=torch.int32)
    tile_start = torch.empty(tiles + 1, dtype=torch.int32)
    pair_start = torch.empty(rows + 1, dtype=torch.int32)
    tiles_per_gauss = torch.zeros(rows, dtype=torch.int32)
    image = (float(width), float(height), tiles_x, tiles_y, active_shortcuts())
    count_pairs(order, records, counts, tiles_per_gauss, n, slices, *image)
    scan_pairs(counts, tile_start, tiles_per_gauss, pair_start, rows, slices, tiles)
    pairs = int(tile_start[-1])
    tile_list = torch.empty(pairs, dtype=torch.int32)
    pair_slot = torch.empty(pairs, dtype=torch.int32)
    fill_pairs(order, records, counts, pair_start, tile_list, pair_slot, n, slices, *image)
    return Bins(visible, records, tile_start, tile_list, pair_start, pair_slot, tiles_per_gauss)
