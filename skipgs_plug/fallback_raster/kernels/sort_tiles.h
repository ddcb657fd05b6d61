// Sorts whole tile lists front to back.
//
// Reads and reorders the unsorted pairs of its own tiles, and writes their sorted lists. No other thread writes to
// these tiles.
#pragma once
#include "lib/sorted_tile.h"
static constexpr auto sort_tiles = [](const TileLists& lists, const Grid& grid, int first, int last) INLINE {
    for (int t = first; t < last; ++t) {
        SortedTile list(lists.tile_start[t], lists.tile_start[t + 1], lists);
        list.sort(list.count);
    }
};
