// Lists the pairs of each tile in row order; sorting follows. A list entry holds the depth in its upper 32 bits and the
// pair's number in its lower 32. Pairs are numbered by row, then tile. Depths are positive, so their bits sort like
// integers.
//
// Reads the records and footprints of its own slices. Writes `pairs` at the positions that `scan_pairs` reserved, and
// advances the next free positions in `counts`. No other thread writes to these positions.
#pragma once
#include "lib/ellipse.h"
#include "lib/slices.h"
#include "lib/tile_lists.h"
static constexpr auto fill_pairs = [](const int* visible, const float* splat_depths, const RecordList& packed,
                                      const Footprints& footprints, const DepthRanges& depths, const PairCounts& counts,
                                      const Pairs& pairs, const Grid& grid, const Slices& slices, int n,
                                      int optimizations, int first, int last) INLINE {
    const int tiles_x = grid.tiles_x;
    const float width = grid.width;
    const BoxTiles tile_of(tiles_x);
    const Record* const records = packed.records;
    const TileBox* const boxes = footprints.boxes;
    int* const pair_record = pairs.record;
    long long* const unsorted = pairs.unsorted;
    for (int s = first; s < last; ++s) {
        int* next = counts.of_tiles + (long long)s * (tiles_x * grid.tiles_y + SPARE_COUNTS);
        int pair = (int)counts.of_slices[s];
        const int begin = slice_begin(s, slices), end = slice_begin(s + 1, slices);
        // Not inlined: few Gaussians are large, and the loop over the others needs the registers.
        const auto list_larger = [=](int k, int* next, long long key, int pair) __attribute__((noinline)) -> int {
            const bool all = !(optimizations & EXACT_TILES);
            each_tile(records[k], boxes[k], width, tiles_x, all, [&](int tile) INLINE {
                if (depths.limited && !depths.ranges[tile].holds((int)(key >> 32))) return;
                pair_record[pair] = k;
                unsorted[next[tile]++] = key | (unsigned)pair++;
            });
            return pair;
        };
        int i = begin;
        for (int k = begin; k < begin + packed.listed_count[s]; ++k) {
            while (i <= packed.listed[k]) pairs.start[i++] = pair;
            const Footprint& footprint = footprints.tiles[k];
            const int depth = ((const int*)splat_depths)[visible[packed.listed[k]]];
            const long long key = (long long)depth << 32;
            if (footprint.meets >= 0) {
                int* corner = next + footprint.corner;
                for (int remaining = footprint.meets; remaining; remaining &= remaining - 1) {
                    pair_record[pair] = k;
                    unsorted[corner[tile_of.offset[__builtin_ctz(remaining)]]++] = key | (unsigned)pair++;
                }
                continue;
            }
            pair = list_larger(k, next, key, pair);
        }
        while (i < end) pairs.start[i++] = pair;
        if (s == slices.number - 1) pairs.start[slices.m] = pair;
    }
};
