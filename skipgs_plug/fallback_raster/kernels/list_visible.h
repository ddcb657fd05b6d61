// The visible rows of all blocks one after the other, and where each block begins among them.
//
// Reads the rows that `project_forward` or `list_open` found in each block. Writes `visible` and `block_start`, alone.
#pragma once
#include "lib/simd.h"
static constexpr auto list_visible = [](const int* found, const int* block_count, int* visible, int* block_start, int blocks,
                                        int first, int last) INLINE {
    int m = 0;
    for (int b = 0; b < blocks; ++b) {
        block_start[b] = m;
        __builtin_memcpy(visible + m, found + (long long)BLOCK * b, sizeof(int) * block_count[b]);
        m += block_count[b];
    }
    block_start[blocks] = m;
};
