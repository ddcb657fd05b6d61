// Per-Gaussian and per-pixel counts that forks of Inria's rasterizer collect while they blend; no colours are computed.
//
// Reads the records and sorted lists of its own tiles. Writes the sums of their pairs and the maps of their pixels. No
// other thread writes to these tiles.
#pragma once
#include "lib/blend_tile.h"
#include "lib/patches.h"
static constexpr auto blend_statistics = [](const SortedLists& lists, const float* values, float* pair_sums,
                                            const StatisticsMaps& maps, const Grid& grid, int first, int last) INLINE {
    for (int t = first; t < last; ++t) {
        const Tile tile(t, lists.tile_start, grid);
        vpatch T[PATCHES], value[PATCHES], most[PATCHES];
        ipatch count[PATCHES], who[PATCHES];
        unsigned open = 0;  // patches with an unfinished pixel
        for (int b = 0; b < PATCHES; ++b) {
            const ipatch inside = tile.inside(b);
            // A negative T marks a pixel that accepts no more Gaussians: it is finished, or outside the image.
            T[b] = inside ? (vpatch)1.0f : (vpatch)-1.0f;
            value[b] = most[b] = (vpatch)0.0f;
            count[b] = (ipatch)0;
            who[b] = (ipatch)-1;
            if (any(inside)) open |= 1u << b;
        }
        for (int q = 0; q < TILE_QUADS; ++q) {
            const Quad quad(tile, q, grid.width);
            read_patches(values, quad, 1, 1, value, 1);
        }

        for (int k = tile.begin; k < tile.end; ++k) {
            vpatch sums[STATISTICS_FLOATS];
            for (int s = 0; s < STATISTICS_FLOATS; ++s) sums[s] = (vpatch)0.0f;
            for (unsigned todo = open; todo; todo &= todo - 1) {
                const int b = __builtin_ctz(todo);
                const Falloff falloff(tile, b, lists.records[lists.tile_record[k]]);
                const vpatch light = T[b];
                const ipatch taken = (falloff.log2_alpha >= LOG2_ALPHA_MIN) & (light > 0.0f);
                if (!any(taken)) continue;
                const vpatch weight = vmin((vpatch)ALPHA_MAX, exp2(falloff.log2_alpha)) * light;
                const ipatch finished = taken & (light - weight <= TRANSMITTANCE_MIN);
                const ipatch hit = taken & ~finished;
                T[b] = hit ? light - weight : (finished ? -light : light);
                const vpatch one = hit ? (vpatch)1.0f : (vpatch)0.0f;
                sums[PIXELS] += one;
                sums[WEIGHT] += one * weight;
                sums[LIGHT] += one * light;
                sums[VALUE] += one * value[b];
                sums[WEIGHTED_VALUE] += one * weight * value[b];
                sums[DISTANCE] += one * vsqrt(falloff.dx * falloff.dx + falloff.dy * falloff.dy);
                count[b] += hit & 1;
                const ipatch leads = hit & (weight > most[b]);
                most[b] = leads ? weight : most[b];
                who[b] = leads ? (ipatch)lists.tile_row[k] : who[b];
                if (any(finished) && !any(T[b] > 0.0f)) open &= ~(1u << b);
            }
            *(v8*)(pair_sums + (long long)STATISTICS_FLOATS * k) = sum8(sums);
        }
        for (int q = 0; q < TILE_QUADS; ++q) {
            const Quad quad(tile, q, grid.width);
            write_patches((float*)maps.contributions, quad, 1, 1, (const vpatch*)count, 1);
            write_patches((float*)maps.strongest, quad, 1, 1, (const vpatch*)who, 1);
        }
    }
};
