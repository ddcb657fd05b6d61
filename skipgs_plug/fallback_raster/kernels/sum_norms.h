// Norms of the gradients of packed 2D means, added to the sums of their rows.
//
// Reads `gradient`. Adds to `norms` and `counts` of the rows of its own items; no row comes twice, so nobody else does.
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
