// Finds the visible rows that may reach a tile that is still open, at depths that the first pass left out.
//
// `open_before` [tiles_y + 1, tiles_x + 1] is a summed-area table: the number of open tiles above and to the left of a
// corner.
//
// Reads the projected splats of visible rows. Writes `found` of its own block. No other thread writes to that block.
#pragma once
#include "lib/simd.h"
static constexpr auto list_open = [](const RowList& visible, const Splats& splats, const int* open_before,
                                     const BlockRows& found, const Grid& grid, int n, int least, int first, int last) INLINE {
    const int tiles_x = grid.tiles_x, tiles_y = grid.tiles_y;
    int found_end = BLOCK_ROWS * first;
    const int end = visible.block_start[first + 1];
    for (int i = visible.block_start[first]; i < end; i += 16) {
        const int lanes = smaller(16, end - i);
        int row[16];
        next_rows(visible.rows + i, lanes, row);
        const i16 deep = (i16)gather(splats.depths, row, 1, 0) >= least;
        if (!any(deep)) continue;
        v16 centre[2], sigma[2];
        gather2(splats.means2d, row, centre);
        gather2(splats.sigmas, row, sigma);
        // One pixel more on each side than the box that the tile lists are made from.
        const v16 reach = log2(vmax(gather(splats.opacities, row, 1, 0), (v16)1e-20f)) - LOG2_ALPHA_MIN;
        const v16 half = 1.001f * vsqrt(vmax(2.0f * reach / LOG2_E, (v16)0.0f)) + 1e-3f;
        const auto tile = [](v16 x, int most) INLINE -> i16 {
            return clamped(x * (1.0f / TILE), 0.0f, (float)most);
        };
        const v16 reach_x = half * sigma[0] + 1.0f, reach_y = half * sigma[1] + 1.0f;
        const i16 left = tile(centre[0] - reach_x, tiles_x - 1), right = tile(centre[0] + reach_x, tiles_x - 1) + 1;
        const i16 top = tile(centre[1] - reach_y, tiles_y - 1), bottom = tile(centre[1] + reach_y, tiles_y - 1) + 1;
        alignas(64) int top_left[16], top_right[16], bottom_left[16], bottom_right[16];  // corners in `open_before`
        const int width = tiles_x + 1;
        *(i16*)top_left = top * width + left, *(i16*)top_right = top * width + right;
        *(i16*)bottom_left = bottom * width + left, *(i16*)bottom_right = bottom * width + right;
        for (unsigned todo = bits(deep) & ((1u << lanes) - 1); todo; todo &= todo - 1) {
            const int l = __builtin_ctz(todo);
            found.rows[found_end] = row[l];
            found_end += open_before[bottom_right[l]] - open_before[bottom_left[l]]
                       > open_before[top_right[l]] - open_before[top_left[l]];
        }
    }
    found.counts[first] = found_end - BLOCK_ROWS * first;
};
