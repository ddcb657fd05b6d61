// Where the pairs of a Gaussian go: slices of the rows, tiles of a small box as bits, and depths that a tile lists.
#pragma once
#include "simd.h"

// The first of `n` rows that belongs to slice `s`; the slice before it ends there.
static constexpr auto slice_begin = [](int s, int n, int slices) -> int { return (int)((long long)s * n / slices); };

// Tiles of a box of a few of them, as bits of an int that is not negative, row by row.
static constexpr int BOX_COLUMNS = 6, BOX_ROWS = 5;
static constexpr int TWO_BY_TWO = 3 | 3 << BOX_COLUMNS;
struct BoxTiles {
    int offset[BOX_COLUMNS * BOX_ROWS];  // from the first tile to that of each bit

    explicit BoxTiles(int tiles_x) {
        for (int j = 0; j < BOX_COLUMNS * BOX_ROWS; ++j) offset[j] = j / BOX_COLUMNS * tiles_x + j % BOX_COLUMNS;
    }
};

// Depths, as bits, that are listed in a tile: from the first of its two numbers up to the second, exclusive.
static constexpr int NO_DEPTH = 0x7fffffff;
static constexpr auto in_range = [](const int* ranges, int tile, int depth) INLINE -> bool {
    return depth >= ranges[2 * tile] && depth < ranges[2 * tile + 1];
};
