// Copies the listed rows of an array to a packed array.
//
// Reads the listed rows of `source`. Writes `taken` at its own positions. No other thread writes to these positions.
#pragma once
#include "lib/simd.h"
static constexpr auto take_rows = [](const int* rows, const float* source, float* taken, int n, int width, int first,
                                     int last) INLINE {
    for (int i = first; i < last; ++i)
        copy_row(taken + (long long)width * i, source + (long long)width * rows[i], width);
};
