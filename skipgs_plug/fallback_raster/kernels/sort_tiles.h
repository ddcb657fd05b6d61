// Sorts whole lists.
#include "lib/sorted_tile.h"
for (int t = first; t < last; ++t) {
    SortedTile sorted(tile_start[t], tile_start[t + 1], unsorted, buffer, tile_list, tile_place, pair_record);
    sorted.sort(sorted.count);
}
