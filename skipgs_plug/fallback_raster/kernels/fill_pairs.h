// Lists the pairs of each tile, as yet in the order of the rows: depth in the upper half, number of the pair in the lower.
// Pairs are numbered by row and tile. Depths are positive, so their bits sort like integers.
#include "lib/box_tiles.h"
#include "lib/ellipse.h"
#include "lib/slice_begin.h"
#include "lib/tile_ranges.h"
for (int s = first; s < last; ++s) {
    int* next = counts + (long long)s * (tiles_x * tiles_y + SPARE_COUNTS);
    int pair = (int)totals[s];
    const int begin = slice_begin(s, n, slices), end = slice_begin(s + 1, n, slices);
    // Not inlined: few are large, and the loop of the others has registers enough without it.
    const auto list_larger = [=](int k, int* next, long long key, int pair) __attribute__((noinline)) -> int {
        const bool all = !(optimizations & EXACT_TILES);
        each_tile(records + (long long)RECORD * k, boxes + (long long)BOX * k, width, tiles_x, all, [&](int tile) INLINE {
            if (limited && !in_range(ranges, tile, (int)(key >> 32))) return;
            pair_record[pair] = k;
            unsorted[next[tile]++] = key | (unsigned)pair++;
        });
        return pair;
    };
    int i = begin;
    for (int k = begin; k < begin + listed_count[s]; ++k) {
        while (i <= listed[k]) pair_start[i++] = pair;
        const int meets = places[(long long)PLACE * k + 1];
        const int depth = ((const int*)depths)[visible[listed[k]]];
        const long long key = (long long)depth << 32;
        if (meets >= 0) {
            int* corner = next + places[(long long)PLACE * k];
            for (int rest = meets; rest; rest &= rest - 1) {
                pair_record[pair] = k;
                unsorted[corner[offset[__builtin_ctz(rest)]]++] = key | (unsigned)pair++;
            }
            continue;
        }
        pair = list_larger(k, next, key, pair);
    }
    while (i < end) pair_start[i++] = pair;
    if (s == slices - 1) pair_start[n] = pair;
}
