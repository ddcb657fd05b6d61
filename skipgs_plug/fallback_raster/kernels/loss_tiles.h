// Sums |image - target| and 1 - SSIM over each tile, and computes the gradient of the loss.
//
// A tile is processed once, from its first row to its last. Two ring buffers of rows hold the inputs of the vertical
// blurs, already blurred along the row. The first holds the maps: x, d, x^2 + y^2 and d^2 of shifted images, where
// d = x - y. The second holds three coefficients of the gradient. Blurring the first ring vertically gives SSIM,
// WINDOW_RADIUS rows late. Blurring the second gives the gradient, another WINDOW_RADIUS rows late.
//
// Reads both images. Writes the sums and the gradient of its own tiles. No other thread writes to these tiles.
#pragma once
#include "lib/simd.h"
// Weights of SSIM's Gaussian window of sigma 1.5 pixels. They add up to 1.
static constexpr float w[SSIM_WINDOW] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                                         0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
static constexpr int WINDOW_RADIUS = SSIM_WINDOW / 2;  // pixels
// Vectors of 16 floats that the window reaches to one side of a tile, for the largest number of channels.
static constexpr int MAX_REACH_VECTORS = (WINDOW_RADIUS * MAX_LOSS_CHANNELS + 15) / 16;
// Most vectors of 16 floats in a row of coefficients, which covers a tile and the window's reach on both sides, and in a
// row of pixels, which reaches as far again.
static constexpr int MAX_COEFFICIENT_VECTORS = LOSS_TILE_VECTORS + 2 * MAX_REACH_VECTORS;
static constexpr int MAX_PIXEL_VECTORS = LOSS_TILE_VECTORS + 4 * MAX_REACH_VECTORS;
enum Map { MAP_X, MAP_D, MAP_SQUARES, MAP_D_SQUARED, MAPS };  // of shifted images
enum Coefficient { OFFSET, SLOPE_D, SLOPE_X, COEFFICIENTS };  // of the gradient
static constexpr int ROWS_AT_ONCE = 4;  // rows blurred vertically together: their windows share most of their inputs
static constexpr int RING_ROWS = SSIM_WINDOW - 1 + ROWS_AT_ONCE;  // rows that one vertical blur reads
// Added to the number of a row to make its ring index positive: rows above an image have negative numbers.
static constexpr int RING_OFFSET = RING_ROWS * 64;
static_assert(4 * WINDOW_RADIUS % ROWS_AT_ONCE == 0, "the gradient begins with the first row of a tile");
// Sums over a tile of |image - target| and of 1 - SSIM.
struct TileLoss {
    float l1, unlike;
};
static_assert(sizeof(TileLoss) == sizeof(float) * TILE_LOSS_FLOATS, "constants.TILE_LOSS_FLOATS");
// Loads 16 values of an image. A byte is divided by 255 with two products: the first factor has so few digits that its
// product is exact, so the sum rounds as the quotient does.
typedef unsigned char c16 __attribute__((ext_vector_type(16), aligned(1)));
static constexpr auto numbers = [](const auto* p) INLINE -> v16 {
    if constexpr (sizeof(*p) == sizeof(float)) return load(p);
    else {
        const v16 a = __builtin_convertvector(__builtin_convertvector(*(const c16*)p, i16), v16);
        return a * 0x1.01p-8f + a * 0x1.010102p-24f;
    }
};
// Blurs ROWS_AT_ONCE rows vertically. The window is symmetric: adding two rows first halves the number of products.
static constexpr auto blur_down = [](const v16* const* from, int at, v16* sums) INLINE {
    v16 row[RING_ROWS];
#pragma clang loop unroll(full)
    for (int k = 0; k < RING_ROWS; ++k) row[k] = from[k][at];
#pragma clang loop unroll(full)
    for (int r = 0; r < ROWS_AT_ONCE; ++r) sums[r] = w[WINDOW_RADIUS] * row[WINDOW_RADIUS + r];
#pragma clang loop unroll(full)
    for (int k = 0; k < WINDOW_RADIUS; ++k)
        for (int r = 0; r < ROWS_AT_ONCE; ++r) sums[r] += w[k] * (row[k + r] + row[SSIM_WINDOW - 1 - k + r]);
};
// Blurs a row horizontally, for the 16 values that begin at `p`.
static constexpr auto blur_along = [](const float* p, int channels) INLINE -> v16 {
#ifdef __AVX512F__
    // Shuffling registers is faster than unaligned loads.
    if (channels == 3) {
#define NEXT_4(i) i, i + 1, i + 2, i + 3
#define NEXT_16(i) NEXT_4(i), NEXT_4(i + 4), NEXT_4(i + 8), NEXT_4(i + 12)
#define BOTH_SIDES(i) __builtin_shufflevector(a, b, NEXT_16(16 - i)) + __builtin_shufflevector(b, c, NEXT_16(i))
        const v16 a = load(p - 16), b = load(p), c = load(p + 16);
        v16 sum = w[WINDOW_RADIUS] * b;
        sum += w[WINDOW_RADIUS - 1] * (BOTH_SIDES(3));
        sum += w[WINDOW_RADIUS - 2] * (BOTH_SIDES(6));
        sum += w[WINDOW_RADIUS - 3] * (BOTH_SIDES(9));
        sum += w[WINDOW_RADIUS - 4] * (BOTH_SIDES(12));
        sum += w[WINDOW_RADIUS - 5] * (BOTH_SIDES(15));
        return sum;
    }
#endif
    v16 sum = w[WINDOW_RADIUS] * load(p);
#pragma clang loop unroll(full)
    for (int k = 1; k <= WINDOW_RADIUS; ++k) sum += w[WINDOW_RADIUS - k] * (load(p - k * channels) + load(p + k * channels));
    return sum;
};
static constexpr auto loss_tiles = [](const float* image, const auto* target, float* gradient, TileLoss* sums,
                                      const ImageSize& size, const LossWeights& weights, int tiles, int valid,
                                      int with_gradient, int first, int last) INLINE {
    const int height = size.height, channels = size.channels;
    const int span = size.width * channels, vectors = (span + 15) / 16;  // floats, and vectors of 16, in a row
    const int reach = WINDOW_RADIUS * channels, side = (reach + 15) / 16;  // of the window to one side
    // Tiles of equal size keep all cores equally busy.
    const int bands = (height + LOSS_TILE_ROWS - 1) / LOSS_TILE_ROWS, band = (height + bands - 1) / bands;
    const int chunks = (vectors + LOSS_TILE_VECTORS - 1) / LOSS_TILE_VECTORS, chunk = (vectors + chunks - 1) / chunks;
    // The gradient needs coefficients beyond the tile's edges, in rows and in vectors.
    const int more_rows = with_gradient ? WINDOW_RADIUS : 0, more = with_gradient ? side : 0;
    for (int item = first; item < last; ++item) {
        const int top = smaller(item / chunks % bands * band, height), bottom = smaller(top + band, height);
        const int begin = smaller(item % chunks * chunk, vectors), own = smaller(begin + chunk, vectors) - begin;
        const long long start = (long long)(item / chunks / bands) * height;  // first row of its image
        const float* x = image + start * span;
        const auto* y = target + start * span;
        const int wide = own + 2 * more, all = wide + 2 * side;
        const int left = 16 * (begin - more);  // column of the first coefficient; pixels begin `side` vectors before it
        // Values `i` to `i + 15` of a row, zero beyond its ends.
        const auto piece = [&](const auto* row, int i) INLINE -> v16 {
            if (i >= 0 && i + 16 <= span) return numbers(row + i);
            __remove_cvref(decltype(*row)) some[16] = {};
            for (int j = larger(0, -i); j < 16 && i + j < span; ++j) some[j] = row[i + j];
            return numbers(some);
        };

        // Shifts that are subtracted from x and d: approximate means of the tile, by channel.
        alignas(64) float shift_x[16 * MAX_PIXEL_VECTORS], shift_d[16 * MAX_PIXEL_VECTORS];
        {
            float mean_x[MAX_LOSS_CHANNELS], mean_y[MAX_LOSS_CHANNELS], counted[MAX_LOSS_CHANNELS];
            for (int c = 0; c < channels; ++c) mean_x[c] = mean_y[c] = counted[c] = 0.0f;
            for (int vector = begin; vector < begin + own; ++vector) {
                v16 a = (v16)0.0f, b = a;
                for (int row = top; row < bottom; row += 8) {
                    a += piece(x + (long long)row * span, 16 * vector);
                    b += piece(y + (long long)row * span, 16 * vector);
                }
                for (int j = 0, c = 16 * vector % channels; j < 16 && 16 * vector + j < span; ++j) {
                    mean_x[c] += a[j];
                    mean_y[c] += b[j];
                    counted[c] += (float)((bottom - top + 7) / 8);
                    c = c + 1 < channels ? c + 1 : 0;
                }
            }
            for (int c = 0; c < channels; ++c) {
                const float share = counted[c] > 0.0f ? 1.0f / counted[c] : 0.0f;
                mean_x[c] *= share;
                mean_y[c] *= share;
            }
            const int column = left - 16 * side;
            for (int j = 0, c = (column + 64 * MAX_REACH_VECTORS * channels) % channels; j < 16 * all; ++j) {
                shift_x[j] = mean_x[c];
                shift_d[j] = mean_x[c] - mean_y[c];
                c = c + 1 < channels ? c + 1 : 0;
            }
        }

        v16 l1 = (v16)0.0f, unlike = (v16)0.0f;
        alignas(64) float maps[MAPS][16 * MAX_PIXEL_VECTORS];
        alignas(64) float slopes[ROWS_AT_ONCE][COEFFICIENTS][16 * MAX_COEFFICIENT_VECTORS];
        alignas(64) v16 blurred[RING_ROWS * MAX_COEFFICIENT_VECTORS * MAPS];
        alignas(64) v16 sloping[RING_ROWS * LOSS_TILE_VECTORS * COEFFICIENTS];
        // Rows are grouped alike with and without a gradient, so that sums are added in the same order.
        const int start_row = top - 2 * WINDOW_RADIUS + (WINDOW_RADIUS - more_rows) / ROWS_AT_ONCE * ROWS_AT_ONCE;
        // Windows of the first groups read rows that were never computed: zeros, which do not count.
        for (int i = 0; i < RING_ROWS * wide * MAPS; ++i) blurred[i] = (v16)0.0f;
        for (int first_row = start_row; first_row < bottom + more_rows + WINDOW_RADIUS; first_row += ROWS_AT_ONCE) {
            for (int row = first_row; row < first_row + ROWS_AT_ONCE; ++row) {
                const bool inside = row >= 0 && row < height, own_row = row >= top && row < bottom;
                const float* line_x = x + (long long)row * span;
                const auto* line_y = y + (long long)row * span;
                for (int vector = 0; vector < all; ++vector) {
                    const int i = left + 16 * (vector - side);
                    v16 a = (v16)0.0f, b = a;
                    if (inside) {
                        a = piece(line_x, i);
                        b = piece(line_y, i);
                        // The hardware prefetcher does not cross pages, and each row lies on a page of its own.
                        __builtin_prefetch(line_x + i + ROWS_AT_ONCE * span);
                        __builtin_prefetch(line_y + i + ROWS_AT_ONCE * span);
                    }
                    if (own_row && vector >= more + side && vector < more + side + own) l1 += vabs(a - b);
                    const v16 from_x = load(shift_x + 16 * vector), from_d = load(shift_d + 16 * vector);
                    const v16 d = a - b - from_d;
                    a -= from_x;
                    b = a - d;
                    store(maps[MAP_X] + 16 * vector, a);
                    store(maps[MAP_D] + 16 * vector, d);
                    store(maps[MAP_SQUARES] + 16 * vector, a * a + b * b);
                    store(maps[MAP_D_SQUARED] + 16 * vector, d * d);
                }
                v16* out = blurred + (row + RING_OFFSET) % RING_ROWS * wide * MAPS;
                for (int vector = 0; vector < wide; ++vector)
                    for (int m = 0; m < MAPS; ++m)
                        out[MAPS * vector + m] = blur_along(maps[m] + 16 * (vector + side), channels);
            }

            const int centre = first_row - WINDOW_RADIUS;  // first of ROWS_AT_ONCE rows whose SSIM is computed
            if (centre + ROWS_AT_ONCE <= top - more_rows) continue;
            const v16* line[RING_ROWS];
            for (int k = 0; k < RING_ROWS; ++k)
                line[k] = blurred + (first_row + ROWS_AT_ONCE + k + RING_OFFSET) % RING_ROWS * wide * MAPS;
            bool own_row[ROWS_AT_ONCE], row_counts[ROWS_AT_ONCE];
            for (int r = 0; r < ROWS_AT_ONCE; ++r) {
                own_row[r] = centre + r >= top && centre + r < bottom;
                row_counts[r] = centre + r >= (valid ? WINDOW_RADIUS : 0)
                             && centre + r < (valid ? height - WINDOW_RADIUS : height);
            }
            for (int vector = 0; vector < wide; ++vector) {
                const int i = left + 16 * vector;
                const v16 column = lane + (float)i;
                const i16 in_row = (column < (float)(valid ? span - reach : span)) & (column >= (float)(valid ? reach : 0));
                const v16 from_x = load(shift_x + 16 * (vector + side)), from_d = load(shift_d + 16 * (vector + side));
                v16 blurs[MAPS][ROWS_AT_ONCE];
                for (int m = 0; m < MAPS; ++m) blur_down(line, MAPS * vector + m, blurs[m]);
                for (int r = 0; r < ROWS_AT_ONCE; ++r) {
                    const v16 blur[MAPS] = {blurs[MAP_X][r], blurs[MAP_D][r], blurs[MAP_SQUARES][r], blurs[MAP_D_SQUARED][r]};
                    const i16 counts = row_counts[r] ? in_row : (i16)0;
                    const v16 mean_x = blur[MAP_X] + from_x, mean_d = blur[MAP_D] + from_d, mean_y = mean_x - mean_d;
                    const v16 shifted_y = blur[MAP_X] - blur[MAP_D];
                    const v16 variances =
                        vmax(blur[MAP_SQUARES] - blur[MAP_X] * blur[MAP_X] - shifted_y * shifted_y, (v16)0.0f);
                    const v16 variance_d = vmax(blur[MAP_D_SQUARED] - blur[MAP_D] * blur[MAP_D], (v16)0.0f);
                    const v16 below1 = mean_x * mean_x + mean_y * mean_y + 1e-4f, below2 = variances + 9e-4f;
                    const v16 both = 1.0f / (below1 * below2), b1 = both * below2, b2 = both * below1;
                    const v16 luminance = mean_d * mean_d * b1, structure = variance_d * b2;
                    if (own_row[r] && vector >= more && vector < more + own)
                        unlike += counts ? luminance + (1.0f - luminance) * structure : (v16)0.0f;
                    if (!with_gradient) continue;
                    // The gradient of 1 - SSIM is blur(offset) + (d - shift_d) blur(slope_d) + (x - shift_x)
                    // blur(slope_x).
                    const v16 slope_d = 2.0f * b2 * (1.0f - luminance), slope_x = -structure * slope_d;
                    const v16 offset = 2.0f * (1.0f - structure) * b1 * mean_d * (1.0f - mean_x * mean_d * b1)
                                   - blur[MAP_D] * slope_d - blur[MAP_X] * slope_x;
                    store(slopes[r][OFFSET] + 16 * vector, counts ? offset : (v16)0.0f);
                    store(slopes[r][SLOPE_D] + 16 * vector, counts ? slope_d : (v16)0.0f);
                    store(slopes[r][SLOPE_X] + 16 * vector, counts ? slope_x : (v16)0.0f);
                }
            }
            if (!with_gradient) continue;
            for (int r = 0; r < ROWS_AT_ONCE; ++r) {
                v16* out = sloping + (centre + r + RING_OFFSET) % RING_ROWS * LOSS_TILE_VECTORS * COEFFICIENTS;
                for (int vector = 0; vector < own; ++vector)
                    for (int m = 0; m < COEFFICIENTS; ++m)
                        out[COEFFICIENTS * vector + m] = blur_along(slopes[r][m] + 16 * (vector + more), channels);
            }

            const int done = centre - WINDOW_RADIUS;  // first of ROWS_AT_ONCE rows whose gradient is computed
            if (done < top) continue;
            for (int k = 0; k < RING_ROWS; ++k)
                line[k] = sloping + (centre + ROWS_AT_ONCE + k + RING_OFFSET) % RING_ROWS * LOSS_TILE_VECTORS * COEFFICIENTS;
            for (int vector = 0; vector < own; ++vector) {
                const int i = 16 * (begin + vector), at = 16 * (vector + more + side);
                v16 blurs[COEFFICIENTS][ROWS_AT_ONCE];
                for (int m = 0; m < COEFFICIENTS; ++m) blur_down(line, COEFFICIENTS * vector + m, blurs[m]);
                for (int r = 0; r < smaller(ROWS_AT_ONCE, bottom - done); ++r) {
                    const v16 blur[COEFFICIENTS] = {blurs[OFFSET][r], blurs[SLOPE_D][r], blurs[SLOPE_X][r]};
                    const long long row = done + r;
                    const v16 a = piece(x + row * span, i), d = a - piece(y + row * span, i);
                    const v16 sign = d > 0.0f ? (v16)1.0f : (d < 0.0f ? (v16)-1.0f : (v16)0.0f);
                    const v16 v_unlike = blur[OFFSET] + (d - load(shift_d + at)) * blur[SLOPE_D]
                                       + (a - load(shift_x + at)) * blur[SLOPE_X];
                    const v16 v = weights.l1 * sign + weights.ssim * v_unlike;
                    float* out = gradient + (start + row) * span + i;
                    if (i + 16 <= span) store(out, v);
                    else for (int j = 0; i + j < span; ++j) out[j] = v[j];
                }
            }
        }
        sums[item] = {sum(l1), sum(unlike)};
    }
};
