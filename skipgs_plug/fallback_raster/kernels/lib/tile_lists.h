// Entries of the tile lists: small boxes of tiles as bits, and ranges of depth.
#pragma once
#include "simd.h"

// A small box of tiles as the bits of a non-negative int, row by row: 6 x 5 tiles use 30 of its 31 bits.
static constexpr int BOX_COLUMNS = 6, BOX_ROWS = 5;
static constexpr int TWO_BY_TWO = 3 | 3 << BOX_COLUMNS;  // bits of the first two tiles of the first two rows
struct BoxTiles {
    int offset[BOX_COLUMNS * BOX_ROWS];  // index of the tile of each bit, minus that of the first tile

    explicit BoxTiles(int tiles_x) {
        for (int j = 0; j < BOX_COLUMNS * BOX_ROWS; ++j) offset[j] = j / BOX_COLUMNS * tiles_x + j % BOX_COLUMNS;
    }
};

// The tiles that a Gaussian meets, if its box is small.
struct Footprint {
    int corner;  // first tile of the box
    int meets;   // bits of the tiles that the ellipse meets; -1 if the box is too large: then it has a `TileBox`
};
static_assert(sizeof(Footprint) == sizeof(int) * FOOTPRINT_INTS, "constants.FOOTPRINT_INTS");

// The depths that a tile lists, as bits of float32: from `first` up to `end`, exclusive.
struct DepthRange {
    int first, end;

    bool holds(int depth) const { return depth >= first && depth < end; }
};
static_assert(sizeof(DepthRange) == sizeof(int) * DEPTH_RANGE_INTS, "constants.DEPTH_RANGE_INTS");
