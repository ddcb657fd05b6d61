// Directions and SH coefficients of 16 Gaussians, moved between memory and registers.
#pragma once
#include "harmonics.h"
#include "simd.h"

// Unit directions from the camera to the Gaussians of 16 rows. Distances were multiplied by norm * shrink.
struct Directions {
    v16 x, y, z, norm, shrink;
};
static constexpr auto directions = [](const float* means, const int* row, int n, const float* position) INLINE -> Directions {
    v16 mean[3];
    gather3(means, row, n, mean);
    const v16 dx = mean[0] - position[0], dy = mean[1] - position[1], dz = mean[2] - position[2];
    // Scale by the longest component first: the square of a tiny or huge distance would leave the range of float.
    const v16 longest = vmax(vabs(dx), vmax(vabs(dy), vabs(dz)));
    Directions d;
    d.shrink = longest > 1e-30f ? 1.0f / longest : (v16)0.0f;
    d.x = dx * d.shrink, d.y = dy * d.shrink, d.z = dz * d.shrink;
    v16 square;
    {
        // Fused by hand, so that both passes compute the same direction: Clang's choice depends on the surrounding
        // code.
#pragma clang fp contract(off)
        square = __builtin_elementwise_fma(d.x, d.x, d.y * d.y) + d.z * d.z;
    }
    d.norm = 1.0f / vsqrt(vmax(square, (v16)1e-30f));
    d.x *= d.norm, d.y *= d.norm, d.z *= d.norm;
    return d;
};

// Prefetches the higher bands of row `g`.
static constexpr auto fetch_bands = [](const Harmonics& sh, int g) INLINE {
    const int count = 3 * ((sh.degree + 1) * (sh.degree + 1) - 1);
    for (int k = 0; k < count; k += 16) __builtin_prefetch(sh.shN + sh.shN_offset + (long long)sh.shN_stride * g + k);
};
// Loads `count` floats of each of 16 rows as columns. Row g begins at p + stride * g. Rows are loaded as vectors of 16
// floats, of which the last overlaps the one before, and transposed.
static constexpr auto take_bands = [](const float* p, const int* row, int stride, int count, v16* columns) INLINE {
    if (count < 16) {
        for (int j = 0; j < count; ++j)
            for (int l = 0; l < 16; ++l) columns[j][l] = p[(long long)stride * row[l] + j];
        return;
    }
    for (int begin = 0; begin < count; begin += 16) {
        const int at = smaller(begin, count - 16);
        v16* own = columns + at;
        for (int l = 0; l < 16; ++l) own[l] = load(p + (long long)stride * row[l] + at);
        transpose(own);
    }
};
// The inverse: stores columns to the first `lanes` rows.
static constexpr auto put_bands = [](float* p, const int* row, int stride, int count, const v16* columns, int lanes) INLINE {
    if (count < 16) {
        for (int j = 0; j < count; ++j)
            for (int l = 0; l < lanes; ++l) p[(long long)stride * row[l] + j] = columns[j][l];
        return;
    }
    for (int begin = 0; begin < count; begin += 16) {
        const int at = smaller(begin, count - 16);
        v16 own[16];
        for (int j = 0; j < 16; ++j) own[j] = columns[at + j];
        transpose(own);
        for (int l = 0; l < lanes; ++l) store(p + (long long)stride * row[l] + at, own[l]);
    }
};
// Loads the constant band of 16 of `n` rows as columns.
static constexpr auto take_constants = [](const Harmonics& sh, const int* row, int n, v16* columns) INLINE {
    if (sh.sh0_stride == 3) gather3(sh.sh0, row, n, columns);
    else take_bands(sh.sh0, row, sh.sh0_stride, 3, columns);
};
