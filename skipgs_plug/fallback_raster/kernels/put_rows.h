// Packed rows back to their places, zeros between them, one block of rows at a time.
//
// Reads `packed`. Writes all rows `put` of its own blocks; nobody else writes there.
#pragma once
#include "lib/simd.h"
static constexpr auto put_rows = [](const RowList& visible, const float* packed, float* put, int n, int width, int first,
                                    int last) INLINE {
    for (int block = first; block < last; ++block) {
        const int row_begin = BLOCK * block;
        clear(put + (long long)width * row_begin, (long long)width * smaller(BLOCK, n - row_begin));
        for (int i = visible.block_start[block]; i < visible.block_start[block + 1]; ++i)
            copy_row(put + (long long)width * visible.rows[i], packed + (long long)width * i, width);
    }
};
