// Turns counts into start positions: of each tile's list, of each slice's part of that list, and of each slice's pairs.
// The total is counted in 64 bits. If it exceeds 32 bits the start positions are invalid, and the caller raises an
// error.
//
// Reads and overwrites `counts`, and writes `tile_start`. It runs on one thread.
#pragma once
#include "lib/simd.h"
static constexpr auto scan_pairs = [](const PairCounts& counts, int* tile_start, const Grid& grid, const Slices& slices,
                                      int first, int last) INLINE {
    const int tiles = grid.tiles_x * grid.tiles_y;
    long long all = 0;
    for (int t = 0; t < tiles; ++t) {
        tile_start[t] = (int)all;
        for (int s = 0; s < slices.number; ++s) {
            int& slice = counts.of_tiles[(long long)s * (tiles + SPARE_COUNTS) + t];
            const int count = slice;
            slice = (int)all;
            all += count;
        }
    }
    tile_start[tiles] = (int)all;
    long long before = 0;
    for (int s = 0; s < slices.number; ++s) {
        const long long pairs = counts.of_slices[s];
        counts.of_slices[s] = before;
        before += pairs;
    }
    counts.of_slices[slices.number] = before;
};
