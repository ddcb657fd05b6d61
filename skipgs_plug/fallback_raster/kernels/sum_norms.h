// Adds the norm of each packed gradient of a 2D mean to the sum of its row, and counts it.
//
// Reads `gradient`. Adds to `norms` and `counts` of the listed rows. No row is listed twice, so no other thread writes
// to it.
#pragma once
#include "lib/simd.h"
static constexpr auto sum_norms = [](const int* rows, const float* gradient, float* norms, float* counts, int n,
                                     float scale_x, float scale_y, int first, int last) INLINE {
    for (int i = first; i < last; ++i) {
        const float x = gradient[2 * i] * scale_x, y = gradient[2 * i + 1] * scale_y;
        norms[rows[i]] += __builtin_sqrtf(x * x + y * y);
        counts[rows[i]] += 1.0f;
    }
};
