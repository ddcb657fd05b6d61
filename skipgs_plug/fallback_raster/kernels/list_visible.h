// Joins the visible rows of all blocks to one list, and notes where each block begins in it.
//
// Reads the rows that `project_forward` or `list_open` found. Writes `visible` and `block_start`. It runs on one
// thread.
#pragma once
#include "lib/simd.h"
static constexpr auto list_visible = [](const int* found, const int* block_count, int* visible, int* block_start, int blocks,
                                        int first, int last) INLINE {
    int m = 0;
    for (int b = 0; b < blocks; ++b) {
        block_start[b] = m;
        __builtin_memcpy(visible + m, found + (long long)BLOCK_ROWS * b, sizeof(int) * block_count[b]);
        m += block_count[b];
    }
    block_start[blocks] = m;
};
