// Lists the pairs of each tile, as yet in the order of the rows: depth in the upper half, number of the pair in the lower.
// Pairs are numbered by row and tile. Depths are positive, so their bits sort like integers.
#include "box_tiles.h"
#include "ellipse.h"
#include "slice_begin.h"
#include "tile_ranges.h"
for (int s = first; s < last; ++s) {
    int* next = counts + (long long)s * (tiles_x * tiles_y + SPARE_COUNTS);
    int pair = (int)totals[s];
    const int begin = slice_begin(s, n, slices), end = slice_begin(s + 1, n, slices);
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
        const int* box = boxes + (long long)BOX * k;
        const Ellipse ellipse(records + (long long)RECORD * k, box, width, shortcuts & EXACT_TILES);
        for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
            int left, right;
            ellipse.columns(ty, left, right);
            for (int tile = ty * tiles_x + left; tile <= ty * tiles_x + right; ++tile) {
                if (limited && !in_range(ranges, tile, depth)) continue;
                pair_record[pair] = k;
                unsorted[next[tile]++] = key | (unsigned)pair++;
            }
        }
    }
    while (i < end) pair_start[i++] = pair;
    if (s == slices - 1) pair_start[n] = pair;
}
