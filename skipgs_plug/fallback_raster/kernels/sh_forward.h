// View-dependent colours of the visible rows of one block, 16 rows at a time. With `dense` all other rows become zero.
//
// Reads the means and coefficients of visible rows. Writes `colors` of its own block. No other thread writes to that
// block.
#pragma once
#include "lib/sh.h"
static constexpr auto sh_forward = [](const float* means, const Harmonics& sh, const RowList& visible, float* colors, int n,
                                      int dense, int first, int last) INLINE {
    const int block = first, terms = (sh.degree + 1) * (sh.degree + 1);
    const int begin = visible.block_start[block], end = visible.block_start[block + 1];
    const int all = visible.block_start[(n + BLOCK_ROWS - 1) / BLOCK_ROWS];
    if (dense) clear(colors + 3ll * BLOCK_ROWS * block, 3 * smaller(BLOCK_ROWS, n - BLOCK_ROWS * block));
    for (int i = begin; i < end; i += 16) {
        const int lanes = smaller(16, end - i);
        int row[16];
        next_rows(visible.rows + i, lanes, row);
        for (int l = 0; l < 16; ++l)
            fetch_bands(sh, visible.rows[smaller(i + 16 + l, all - 1)]);
        v16 basis[16], bands[48], constant[3], c[3];
        const Directions d = directions(means, row, n, sh.position);
        harmonics(d.x, d.y, d.z, sh.degree, basis);
        take_constants(sh, row, n, constant);
        take_bands(sh.shN + sh.shN_offset, row, sh.shN_stride, 3 * (terms - 1), bands);
        for (int k = 0; k < 3; ++k) c[k] = 0.5f + basis[0] * constant[k];
        for (int band = 1; band < terms; ++band)
            for (int k = 0; k < 3; ++k) c[k] += basis[band] * bands[3 * band - 3 + k];
        // The comparison is false for NaN, so NaN stays NaN: a bad coefficient must show in the pixels that it reaches.
        for (int k = 0; k < 3; ++k) c[k] = c[k] < 0.0f ? (v16)0.0f : c[k];
        scatter3(colors, row, c[0], c[1], c[2], lanes);
    }
};
