// Scatters packed rows back to their row numbers and fills all other rows with zeros, one block at a time.
//
// Reads `packed`. Writes all rows of `put` in its own blocks. No other thread writes to these blocks.
#pragma once
#include "lib/simd.h"
static constexpr auto put_rows = [](const RowList& visible, const float* packed, float* put, int n, int width, int first,
                                    int last) INLINE {
    for (int block = first; block < last; ++block) {
        const int row_begin = BLOCK_ROWS * block;
        clear(put + (long long)width * row_begin, (long long)width * smaller(BLOCK_ROWS, n - row_begin));
        for (int i = visible.block_start[block]; i < visible.block_start[block + 1]; ++i)
            copy_row(put + (long long)width * visible.rows[i], packed + (long long)width * i, width);
    }
};
