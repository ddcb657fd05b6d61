#include "harmonics.h"
// Unit directions x, y, z from the camera to the Gaussians of 16 rows; norm * shrink is what the distances were multiplied
// with.
static constexpr auto directions = [](const float* means, const int* row, int n, const float* camera, v16& x, v16& y,
                                      v16& z, v16& norm, v16& shrink) INLINE {
    v16 mean[3];
    gather3(means, row, n, mean);
    const v16 dx = mean[0] - camera[0], dy = mean[1] - camera[1], dz = mean[2] - camera[2];
    // Scaled by the longest side first: the square of a tiny or huge distance would leave float's range.
    const v16 longest = vmax(vabs(dx), vmax(vabs(dy), vabs(dz)));
    shrink = longest > 1e-30f ? 1.0f / longest : (v16)0.0f;
    x = dx * shrink, y = dy * shrink, z = dz * shrink;
    v16 square;
    {
        // Fused by hand, so that both passes get one direction: Clang's choice depends on what stands around.
#pragma clang fp contract(off)
        square = __builtin_elementwise_fma(x, x, y * y) + z * z;
    }
    norm = 1.0f / vsqrt(vmax(square, (v16)1e-30f));
    x *= norm, y *= norm, z *= norm;
};
// Fetches `count` numbers of row g ahead of their use.
static constexpr auto fetch_bands = [](const float* p, int g, int stride, int count) INLINE {
    for (int k = 0; k < count; k += 16) __builtin_prefetch(p + (long long)stride * g + k);
};
// `count` numbers of 16 rows, those of row g from p + stride g on, as columns. Rows move as a whole, 16 numbers to a vector,
// of which the last overlap those before them.
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
// The other way round, for the first `lanes` rows.
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
// The constant band of 16 rows of `n`.
static constexpr auto take_constants = [](const float* p, const int* row, int n, int stride, v16* columns) INLINE {
    if (stride == 3) gather3(p, row, n, columns);
    else take_bands(p, row, stride, 3, columns);
};
