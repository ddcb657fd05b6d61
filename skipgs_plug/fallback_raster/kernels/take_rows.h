// Some rows of an array, packed.
//
// Reads the named rows of `source`. Writes `taken` of its own places; nobody else writes there.
#pragma once
#include "lib/simd.h"
static constexpr auto take_rows = [](const int* rows, const float* source, float* taken, int n, int width, int first,
                                     int last) INLINE {
    for (int i = first; i < last; ++i)
        copy_row(taken + (long long)width * i, source + (long long)width * rows[i], width);
};
