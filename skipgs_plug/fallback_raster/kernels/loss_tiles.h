// |image - target| and 1 - SSIM summed over each tile, and the gradient of the loss.
//
// A tile goes down its rows once. What the window needs of the rows above stays in two rings of rows: x, d,
// x^2 + y^2 and d^2, all less the shifts and blurred along the row; and the slopes of 1 - SSIM, likewise blurred. Blurring
// both down the rows gives SSIM RADIUS rows later, and the gradient another RADIUS rows later.
//
// Reads both images. Writes sums and gradient of its own tiles; nobody else writes there.
#pragma once
#include "lib/simd.h"
static constexpr float w[WINDOW] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                                    0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
static constexpr int RADIUS = WINDOW / 2;
static constexpr int MOST = (RADIUS * LOSS_CHANNELS + 15) / 16;  // vectors that the window reaches to one side
static constexpr int STEP = 4;  // rows at a time: their windows share most of what they read
static constexpr int RING = WINDOW - 1 + STEP;
static constexpr int AHEAD = RING * 64;  // rows above an image have numbers below zero
static_assert(4 * RADIUS % STEP == 0, "the gradient begins with the first row of a tile");
// Numbers of an image, 16 at a time. Bytes count in 255ths: the first of two parts of 1 / 255 has so few digits that its
// product is exact, so that the sum is rounded as the quotient is.
typedef unsigned char c16 __attribute__((ext_vector_type(16), aligned(1)));
static constexpr auto numbers = [](const auto* p) INLINE -> v16 {
    if constexpr (sizeof(*p) == sizeof(float)) return load(p);
    else {
        const v16 a = __builtin_convertvector(__builtin_convertvector(*(const c16*)p, i16), v16);
        return a * 0x1.01p-8f + a * 0x1.010102p-24f;
    }
};
// The window down the rows, for STEP of them. Its halves are equal: sums of two rows, then half as many products.
static constexpr auto blur_down = [](const v16* const* from, int at, v16* sums) INLINE {
    v16 row[RING];
#pragma clang loop unroll(full)
    for (int k = 0; k < RING; ++k) row[k] = from[k][at];
#pragma clang loop unroll(full)
    for (int r = 0; r < STEP; ++r) sums[r] = w[RADIUS] * row[RADIUS + r];
#pragma clang loop unroll(full)
    for (int k = 0; k < RADIUS; ++k)
        for (int r = 0; r < STEP; ++r) sums[r] += w[k] * (row[k + r] + row[WINDOW - 1 - k + r]);
};
// The window along a row, around `p[0]` to `p[15]`.
static constexpr auto blur_along = [](const float* p, int channels) INLINE -> v16 {
#ifdef __AVX512F__
    // A load that is not aligned takes longer than moving numbers between registers.
    if (channels == 3) {
#define FOUR(i) i, i + 1, i + 2, i + 3
#define SIXTEEN(i) FOUR(i), FOUR(i + 4), FOUR(i + 8), FOUR(i + 12)
#define BOTH_SIDES(i) __builtin_shufflevector(a, b, SIXTEEN(16 - i)) + __builtin_shufflevector(b, c, SIXTEEN(i))
        const v16 a = load(p - 16), b = load(p), c = load(p + 16);
        v16 sum = w[RADIUS] * b;
        sum += w[RADIUS - 1] * (BOTH_SIDES(3));
        sum += w[RADIUS - 2] * (BOTH_SIDES(6));
        sum += w[RADIUS - 3] * (BOTH_SIDES(9));
        sum += w[RADIUS - 4] * (BOTH_SIDES(12));
        sum += w[RADIUS - 5] * (BOTH_SIDES(15));
        return sum;
    }
#endif
    v16 sum = w[RADIUS] * load(p);
#pragma clang loop unroll(full)
    for (int k = 1; k <= RADIUS; ++k) sum += w[RADIUS - k] * (load(p - k * channels) + load(p + k * channels));
    return sum;
};
static constexpr auto loss_tiles = [](const float* image, const auto* target, float* gradient, float* sums, const ImageSize& size,
                                      const LossWeights& weights, int tiles, int valid, int with_gradient, int first,
                                      int last) INLINE {
    const int height = size.height, channels = size.channels;
    const int span = size.width * channels, vectors = (span + 15) / 16, reach = RADIUS * channels, side = (reach + 15) / 16;
    // Tiles of equal size, so that no core waits for another's.
    const int bands = (height + LOSS_ROWS - 1) / LOSS_ROWS, band = (height + bands - 1) / bands;
    const int chunks = (vectors + LOSS_VECTORS - 1) / LOSS_VECTORS, chunk = (vectors + chunks - 1) / chunks;
    // The gradient needs slopes beyond the tile, in rows and in vectors.
    const int more_rows = with_gradient ? RADIUS : 0, more = with_gradient ? side : 0;
    for (int item = first; item < last; ++item) {
        const int top = smaller(item / chunks % bands * band, height), bottom = smaller(top + band, height);
        const int begin = smaller(item % chunks * chunk, vectors), own = smaller(begin + chunk, vectors) - begin;
        const long long start = (long long)(item / chunks / bands) * height;  // first row of its image
        const float* x = image + start * span;
        const auto* y = target + start * span;
        const int wide = own + 2 * more, all = wide + 2 * side;
        const int left = 16 * (begin - more);  // column of the first slope, and beyond by `side` vectors of the first pixel
        // Numbers `i` to `i + 15` of a row, black beyond its ends.
        const auto piece = [&](const auto* row, int i) INLINE -> v16 {
            if (i >= 0 && i + 16 <= span) return numbers(row + i);
            __remove_cvref(decltype(*row)) some[16] = {};
            for (int j = larger(0, -i); j < 16 && i + j < span; ++j) some[j] = row[i + j];
            return numbers(some);
        };

        // What x and d are counted from: about their mean in the tile, by channel.
        alignas(64) float shift_x[16 * (LOSS_VECTORS + 4 * MOST)], shift_d[16 * (LOSS_VECTORS + 4 * MOST)];
        {
            float mean_x[LOSS_CHANNELS], mean_y[LOSS_CHANNELS], counted[LOSS_CHANNELS];
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
            for (int j = 0, c = (column + 64 * MOST * channels) % channels; j < 16 * all; ++j) {
                shift_x[j] = mean_x[c];
                shift_d[j] = mean_x[c] - mean_y[c];
                c = c + 1 < channels ? c + 1 : 0;
            }
        }

        v16 l1 = (v16)0.0f, unlike = (v16)0.0f;
        alignas(64) float maps[4][16 * (LOSS_VECTORS + 4 * MOST)], slopes[STEP][3][16 * (LOSS_VECTORS + 2 * MOST)];
        alignas(64) v16 blurred[RING * (LOSS_VECTORS + 2 * MOST) * 4], sloping[RING * LOSS_VECTORS * 3];
        // Without a gradient the rows are grouped as with one, so that sums are added in the same order.
        const int start_row = top - 2 * RADIUS + (RADIUS - more_rows) / STEP * STEP;
        // Rows before the first are read and count for nothing.
        for (int i = 0; i < RING * wide * 4; ++i) blurred[i] = (v16)0.0f;
        for (int first_row = start_row; first_row < bottom + more_rows + RADIUS; first_row += STEP) {
            for (int row = first_row; row < first_row + STEP; ++row) {
                const bool inside = row >= 0 && row < height, own_row = row >= top && row < bottom;
                const float* line_x = x + (long long)row * span;
                const auto* line_y = y + (long long)row * span;
                for (int vector = 0; vector < all; ++vector) {
                    const int i = left + 16 * (vector - side);
                    v16 a = (v16)0.0f, b = a;
                    if (inside) {
                        a = piece(line_x, i);
                        b = piece(line_y, i);
                        // Rows lie on pages of their own, where nothing foresees what is read next.
                        __builtin_prefetch(line_x + i + STEP * span);
                        __builtin_prefetch(line_y + i + STEP * span);
                    }
                    if (own_row && vector >= more + side && vector < more + side + own) l1 += vabs(a - b);
                    const v16 from_x = load(shift_x + 16 * vector), from_d = load(shift_d + 16 * vector);
                    const v16 d = a - b - from_d;
                    a -= from_x;
                    b = a - d;
                    store(maps[0] + 16 * vector, a);
                    store(maps[1] + 16 * vector, d);
                    store(maps[2] + 16 * vector, a * a + b * b);
                    store(maps[3] + 16 * vector, d * d);
                }
                v16* out = blurred + (row + AHEAD) % RING * wide * 4;
                for (int vector = 0; vector < wide; ++vector)
                    for (int m = 0; m < 4; ++m) out[4 * vector + m] = blur_along(maps[m] + 16 * (vector + side), channels);
            }

            const int centre = first_row - RADIUS;  // and the next ones
            if (centre + STEP <= top - more_rows) continue;
            const v16* line[RING];
            for (int k = 0; k < RING; ++k) line[k] = blurred + (first_row + STEP + k + AHEAD) % RING * wide * 4;
            bool own_row[STEP], row_counts[STEP];
            for (int r = 0; r < STEP; ++r) {
                own_row[r] = centre + r >= top && centre + r < bottom;
                row_counts[r] = centre + r >= (valid ? RADIUS : 0) && centre + r < (valid ? height - RADIUS : height);
            }
            for (int vector = 0; vector < wide; ++vector) {
                const int i = left + 16 * vector;
                const v16 column = lane + (float)i;
                const i16 in_row = (column < (float)(valid ? span - reach : span)) & (column >= (float)(valid ? reach : 0));
                const v16 from_x = load(shift_x + 16 * (vector + side)), from_d = load(shift_d + 16 * (vector + side));
                v16 blurs[4][STEP];
                for (int m = 0; m < 4; ++m) blur_down(line, 4 * vector + m, blurs[m]);
                for (int r = 0; r < STEP; ++r) {
                    const v16 blur[4] = {blurs[0][r], blurs[1][r], blurs[2][r], blurs[3][r]};
                    const i16 counts = row_counts[r] ? in_row : (i16)0;
                    const v16 mean_x = blur[0] + from_x, mean_d = blur[1] + from_d, mean_y = mean_x - mean_d;
                    const v16 shifted_y = blur[0] - blur[1];
                    const v16 variances = vmax(blur[2] - blur[0] * blur[0] - shifted_y * shifted_y, (v16)0.0f);
                    const v16 variance_d = vmax(blur[3] - blur[1] * blur[1], (v16)0.0f);
                    const v16 below1 = mean_x * mean_x + mean_y * mean_y + 1e-4f, below2 = variances + 9e-4f;
                    const v16 both = 1.0f / (below1 * below2), b1 = both * below2, b2 = both * below1;
                    const v16 luminance = mean_d * mean_d * b1, structure = variance_d * b2;
                    if (own_row[r] && vector >= more && vector < more + own)
                        unlike += counts ? luminance + (1.0f - luminance) * structure : (v16)0.0f;
                    if (!with_gradient) continue;
                    // The gradient of 1 - SSIM is blur(offset) + (d - shift_d) blur(slope_d) + (x - shift_x) blur(slope_x).
                    const v16 slope_d = 2.0f * b2 * (1.0f - luminance), slope_x = -structure * slope_d;
                    const v16 offset = 2.0f * (1.0f - structure) * b1 * mean_d * (1.0f - mean_x * mean_d * b1)
                                   - blur[1] * slope_d - blur[0] * slope_x;
                    store(slopes[r][0] + 16 * vector, counts ? offset : (v16)0.0f);
                    store(slopes[r][1] + 16 * vector, counts ? slope_d : (v16)0.0f);
                    store(slopes[r][2] + 16 * vector, counts ? slope_x : (v16)0.0f);
                }
            }
            if (!with_gradient) continue;
            for (int r = 0; r < STEP; ++r) {
                v16* out = sloping + (centre + r + AHEAD) % RING * LOSS_VECTORS * 3;
                for (int vector = 0; vector < own; ++vector)
                    for (int m = 0; m < 3; ++m) out[3 * vector + m] = blur_along(slopes[r][m] + 16 * (vector + more), channels);
            }

            const int done = centre - RADIUS;  // and the next ones
            if (done < top) continue;
            for (int k = 0; k < RING; ++k) line[k] = sloping + (centre + STEP + k + AHEAD) % RING * LOSS_VECTORS * 3;
            for (int vector = 0; vector < own; ++vector) {
                const int i = 16 * (begin + vector), at = 16 * (vector + more + side);
                v16 blurs[3][STEP];
                for (int m = 0; m < 3; ++m) blur_down(line, 3 * vector + m, blurs[m]);
                for (int r = 0; r < smaller(STEP, bottom - done); ++r) {
                    const v16 blur[3] = {blurs[0][r], blurs[1][r], blurs[2][r]};
                    const long long row = done + r;
                    const v16 a = piece(x + row * span, i), d = a - piece(y + row * span, i);
                    const v16 sign = d > 0.0f ? (v16)1.0f : (d < 0.0f ? (v16)-1.0f : (v16)0.0f);
                    const v16 v_unlike = blur[0] + (d - load(shift_d + at)) * blur[1] + (a - load(shift_x + at)) * blur[2];
                    const v16 v = weights.l1 * sign + weights.ssim * v_unlike;
                    float* out = gradient + (start + row) * span + i;
                    if (i + 16 <= span) store(out, v);
                    else for (int j = 0; i + j < span; ++j) out[j] = v[j];
                }
            }
        }
        sums[2 * item] = sum(l1);
        sums[2 * item + 1] = sum(unlike);
    }
};
