// What the forks of Inria's rasterizer count inside their blend, one tile at a time, without the colours.
#include "lib/blend_tile.h"
#include "lib/pixels.h"
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);
    vblock T[BLOCKS], value[BLOCKS], most[BLOCKS];
    iblock count[BLOCKS], who[BLOCKS];
    unsigned open = 0;  // blocks with an unfinished pixel
    for (int b = 0; b < BLOCKS; ++b) {
        const iblock inside = tile.inside(b);
        // The sign of T marks pixels that take no more: finished ones and those outside the image.
        T[b] = inside ? (vblock)1.0f : (vblock)-1.0f;
        value[b] = most[b] = (vblock)0.0f;
        count[b] = (iblock)0;
        who[b] = (iblock)-1;
        if (any(inside)) open |= 1u << b;
    }
    for (int q = 0; q < QUADS; ++q) {
        const Quad quad(tile, q, width);
        read_blocks(values, quad, 1, 1, value, 1);
    }

    for (int k = tile.begin; k < tile.end; ++k) {
        vblock sums[SUMS];
        for (int s = 0; s < SUMS; ++s) sums[s] = (vblock)0.0f;
        for (unsigned todo = open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            const Falloff seen(tile, b, records + (long long)RECORD * tile_list[k]);
            const vblock light = T[b];
            const iblock taken = (seen.log2_alpha >= LOG2_ALPHA_MIN) & (light > 0.0f);
            if (!any(taken)) continue;
            const vblock weight = vmin((vblock)ALPHA_MAX, exp2(seen.log2_alpha)) * light;
            const iblock finished = taken & (light - weight <= TRANSMITTANCE_MIN);
            const iblock hit = taken & ~finished;
            T[b] = hit ? light - weight : (finished ? -light : light);
            const vblock one = hit ? (vblock)1.0f : (vblock)0.0f;
            sums[0] += one;
            sums[1] += one * weight;
            sums[2] += one * light;
            sums[3] += one * value[b];
            sums[4] += one * weight * value[b];
            sums[5] += one * vsqrt(seen.dx * seen.dx + seen.dy * seen.dy);
            count[b] += hit & 1;
            const iblock leads = hit & (weight > most[b]);
            most[b] = leads ? weight : most[b];
            who[b] = leads ? (iblock)tile_rows[k] : who[b];
            if (any(finished) && !any(T[b] > 0.0f)) open &= ~(1u << b);
        }
        *(v8*)(pair_sums + (long long)SUMS * k) = sum8(sums);
    }
    for (int q = 0; q < QUADS; ++q) {
        const Quad quad(tile, q, width);
        write_blocks((float*)contributions, quad, 1, 1, (const vblock*)count, 1);
        write_blocks((float*)strongest, quad, 1, 1, (const vblock*)who, 1);
    }
}
