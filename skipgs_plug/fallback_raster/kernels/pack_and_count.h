// Packs the records of the visible rows that have pairs, finds their footprints on the tiles, and counts the pairs of
// each tile, by slice of the rows. Where `depths` are limited, it counts only pairs whose depth lies in the range of
// their tile.
//
// Reads the projected splats and `colors`. Writes the records, footprints and counts of its own slices, and
// `tiles_per_gauss` of their rows. No other thread writes to these slices.
#pragma once
#include "lib/ellipse.h"
#include "lib/slices.h"
#include "lib/tile_lists.h"
static constexpr auto pack_and_count =
    [](const int* visible, const Splats& splats, const float* colors, const Channels& channels, const DepthRanges& depths,
       const RecordList& packed, const Footprints& footprints, const PairCounts& counts, int* tiles_per_gauss,
       const Grid& grid, const Slices& slices, int n, const PackFlags& flags, int first, int last) INLINE {
    const int tiles_x = grid.tiles_x, tiles = tiles_x * grid.tiles_y;
    const float width = grid.width, height = grid.height;
    const bool limited = depths.limited;
    const int dense = flags.dense, optimizations = flags.optimizations;
    const BoxTiles tile_of(tiles_x);
    Record* const records = packed.records;
    TileBox* const boxes = footprints.boxes;
    const auto add_two = [](int* to, const int* numbers) INLINE {
        typedef int two __attribute__((ext_vector_type(2), aligned(4)));
        *(two*)to += *(const two*)numbers;
    };
    int least = limited ? NO_DEPTH : -NO_DEPTH, most = limited ? -NO_DEPTH : NO_DEPTH;
    for (int t = 0; limited && t < tiles; ++t) {
        least = smaller(least, depths.ranges[t].first);
        most = larger(most, depths.ranges[t].end);
    }
    for (int s = first; s < last; ++s) {
        int* count = counts.of_tiles + (long long)s * (tiles + SPARE_COUNTS);
        for (int t = 0; t < tiles + SPARE_COUNTS; ++t) count[t] = 0;
        long long of_slice = 0;
        int found = 0;
        const int begin = slice_begin(s, slices), end = slice_begin(s + 1, slices);
        if (dense) {
            const int row_begin = s > 0 ? visible[begin] : 0, row_end = s < slices.number - 1 ? visible[end] : n;
            clear((float*)tiles_per_gauss + row_begin, row_end - row_begin);
        }
        for (int i = begin; i < end; i += 16) {
            const int lanes = smaller(16, end - i);
            int row[16];
            next_rows(visible + i, lanes, row);
            const i16 depth = (i16)gather(splats.depths, row, 1, 0);
            const i16 near = (depth >= least) & (depth < most);
            if (!dense && !any(near)) continue;
            v16 conic[3], sigma[2], centre[2];
            gather3(splats.conics, row, n, conic);
            gather2(splats.sigmas, row, sigma);
            gather2(splats.means2d, row, centre);
            const v16 a = conic[0], b = conic[1], c = conic[2], mx = centre[0], my = centre[1];
            v16 log2_opacity = log2(vmax(gather(splats.opacities, row, 1, 0), (v16)1e-20f));
            v16 reach = log2_opacity - LOG2_ALPHA_MIN;
            // a dx^2 + 2 b dx dy + c dy^2 = a (dx + b / a dy)^2 + dy^2 / sigma_y^2: a sum of squares stays positive for
            // any needle.
            v16 along = vsqrt(0.5f * LOG2_E * a), across = vsqrt((v16)(0.5f * LOG2_E)) / sigma[1];
            // Half sides of the box around alpha >= ALPHA_MIN, slightly larger than exact: the blend tests every pixel
            // itself.
            v16 half = vsqrt(vmax(2.0f * reach / LOG2_E, (v16)0.0f)) * 1.0001f + 1e-3f;
            const v16 half_w = half * sigma[0], half_h = half * sigma[1];
            const v16 slope = b / a, steepness = b / c;

            // Columns and rows of pixels whose centres lie in the box.
            const i16 left = clamped(__builtin_elementwise_ceil(mx - half_w - 0.5f), 0.0f, width);
            const i16 right = clamped(__builtin_elementwise_floor(mx + half_w - 0.5f), -1.0f, width - 1.0f);
            const i16 top = clamped(__builtin_elementwise_ceil(my - half_h - 0.5f), 0.0f, height);
            const i16 bottom = clamped(__builtin_elementwise_floor(my + half_h - 0.5f), -1.0f, height - 1.0f);
            static_assert(TILE == 16, "pixels to tiles");
            const i16 empty = (left > right) | (top > bottom);
            alignas(64) struct { int first_column[16], last_column[16], first_row[16], last_row[16]; } box;  // by lane
            const i16 first_column = left >> 4, last_column = right >> 4, first_row = top >> 4, last_row = bottom >> 4;
            *(i16*)box.first_column = first_column, *(i16*)box.last_column = last_column;
            *(i16*)box.first_row = first_row, *(i16*)box.last_row = last_row;
            // The tiles of a small box that the ellipse meets.
            const i16 columns = last_column - first_column, lines = last_row - first_row;
            const i16 small = (columns < BOX_COLUMNS) & (lines < BOX_ROWS);
            Records16 record = {
                mx,     my, along,  along * slope, across, log2_opacity, half_h,
                half_w, {}, -slope, -steepness,    reach,  1.0f / along,
            };
            const Ellipses ellipses(record);
            i16 meets = (i16)0, met = (i16)0;
            const int deepest = __builtin_reduce_max(small ? lines : (i16)0);
            for (int r = 0; r <= deepest; ++r) {
                i16 left = first_column, right = last_column;
                if (optimizations & EXACT_TILES) ellipses.columns(first_row + r, width, left, right);
                left = vmax(left - first_column, (i16)0);
                right = vmin(right - first_column, vmin(columns, (i16)(BOX_COLUMNS - 1)));
                const i16 hit = small & (r <= lines) & (left <= right);
                left = hit ? left : (i16)0, right = hit ? right : (i16)0;  // shifts by negative numbers are undefined
                meets |= hit & ((((i16)2 << right) - ((i16)1 << left)) << BOX_COLUMNS * r);
                met += hit & (right - left + 1);
            }
            meets = empty ? (i16)0 : (small ? meets : (i16)-1);
            met = meets > 0 ? met : (i16)0;
            const i16 corner = first_row * tiles_x + first_column;

            // The tiles of a large ellipse are counted from its record. With `dense` it gets one even if its depth is
            // out of range.
            const i16 wanted = (meets != 0) & (near | ((meets < 0) & (dense ? -1 : 0)));
            if (dense) scatter((float*)tiles_per_gauss, row, (v16)met, lanes);
            const unsigned chosen = bits(wanted) & ((1u << lanes) - 1);
            if (!chosen) continue;
            if (channels.stride == 3 && channels.number == 3) gather3(colors, row, n, record.color);
            else
                for (int k = 0; k < channels.number; ++k) record.color[k] = gather(colors, row, channels.stride, k);
            v16* const by_lane = (v16*)&record;
            transpose(by_lane);
            // By lane: the footprint; pairs in the two upper tiles; pairs in the two lower tiles, which begin at
            // `below`.
            alignas(64) Footprint footprint[16];
            alignas(64) int upper[16][2], lower[16][2], below[16], key[16];
            interleave2((v16)corner, (v16)meets, (float*)footprint);
            interleave2((v16)(meets & 1), (v16)(meets >> 1 & 1), (float*)upper[0]);
            interleave2((v16)(meets >> BOX_COLUMNS & 1), (v16)(meets >> (BOX_COLUMNS + 1) & 1), (float*)lower[0]);
            *(i16*)below = last_row > first_row ? corner + tiles_x : (i16)tiles;
            *(i16*)key = depth;
            const unsigned tiny = bits((meets & ~TWO_BY_TWO) == 0);  // lanes whose box is at most 2 x 2 tiles
            if (chosen == 0xffff && tiny == 0xffff && !limited) {
                for (int l = 0; l < 16; ++l) {
                    footprints.tiles[begin + found + l] = footprint[l];
                    store((float*)(records + begin + found + l), by_lane[l]);
                    packed.listed[begin + found + l] = i + l;
                    // Add to two counters at a time: a branch for each would often be mispredicted.
                    add_two(count + footprint[l].corner, upper[l]);
                    add_two(count + below[l], lower[l]);
                }
                of_slice += __builtin_reduce_add(met);
                found += 16;
                continue;
            }
            for (unsigned remaining = chosen; remaining; remaining &= remaining - 1) {
                const int l = __builtin_ctz(remaining), corner = footprint[l].corner;
                int own_meets = footprint[l].meets, pairs = 0;
                Record& own_record = records[begin + found];  // overwritten by the next record if this one has no pairs
                store((float*)&own_record, by_lane[l]);
                if (!limited && (tiny >> l & 1)) {
                    add_two(count + corner, upper[l]);
                    add_two(count + below[l], lower[l]);
                    pairs = __builtin_popcount(own_meets);
                } else if (own_meets >= 0) {
                    for (int todo = limited ? own_meets : 0; todo; todo &= todo - 1) {
                        const int j = __builtin_ctz(todo);
                        if (!depths.ranges[corner + tile_of.offset[j]].holds(key[l])) own_meets &= ~(1 << j);
                    }
                    for (int todo = own_meets; todo; todo &= todo - 1) ++count[corner + tile_of.offset[__builtin_ctz(todo)]];
                    pairs = __builtin_popcount(own_meets);
                } else {
                    int met = 0;
                    TileBox& own = boxes[begin + found];
                    own = {box.first_column[l], box.last_column[l], box.first_row[l], box.last_row[l]};
                    each_tile(own_record, own, width, tiles_x, !(optimizations & EXACT_TILES), [&](int tile) INLINE {
                        ++met;
                        if (!limited || depths.ranges[tile].holds(key[l])) ++count[tile], ++pairs;
                    });
                    if (dense) tiles_per_gauss[row[l]] = met;
                }
                of_slice += pairs;
                footprints.tiles[begin + found] = {corner, own_meets};
                packed.listed[begin + found] = i + l;
                found += pairs > 0;
            }
        }
        packed.listed_count[s] = found;
        counts.of_slices[s] = of_slice;
    }
};
