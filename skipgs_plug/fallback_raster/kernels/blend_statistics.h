// What the forks of Inria's rasterizer count inside their blend, one tile at a time, without the colours.
#include "blend_tile.h"
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);
    v16 T[16], value[16], most[16];
    i16 count[16], who[16];
    unsigned open = 0;  // blocks with an unfinished pixel
    for (int b = 0; b < 16; ++b) {
        const i16 inside = (lane_x + 4 * (b & 3) < (float)tile.columns) & (lane_y + 4 * (b >> 2) < (float)tile.rows);
        // The sign of T marks pixels that take no more: finished ones and those outside the image.
        T[b] = inside ? (v16)1.0f : (v16)-1.0f;
        value[b] = most[b] = (v16)0.0f;
        count[b] = (i16)0;
        who[b] = (i16)-1;
        if (any(inside)) open |= 1u << b;
    }
    for (int y = 0; y < tile.rows; ++y)
        for (int x = 0; x < tile.columns; ++x)
            value[y / 4 * 4 + x / 4][y % 4 * 4 + x % 4] = values[(long long)(tile.y0 + y) * width + tile.x0 + x];

    for (int k = tile.begin; k < tile.end; ++k) {
        const int g = tile_list[k];
        v16 sums[SUMS];
        for (int s = 0; s < SUMS; ++s) sums[s] = (v16)0.0f;
        for (unsigned todo = open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            const Falloff seen(tile, b, records + (long long)RECORD * g);
            const v16 light = T[b];
            const i16 taken = (seen.log2_alpha >= LOG2_ALPHA_MIN) & (light > 0.0f);
            if (!any(taken)) continue;
            const v16 weight = vmin((v16)ALPHA_MAX, exp2(seen.log2_alpha)) * light;
            const i16 finished = taken & (light - weight <= TRANSMITTANCE_MIN);
            const i16 hit = taken & ~finished;
            T[b] = hit ? light - weight : (finished ? -light : light);
            const v16 one = hit ? (v16)1.0f : (v16)0.0f;
            sums[0] += one;
            sums[1] += one * weight;
            sums[2] += one * light;
            sums[3] += one * value[b];
            sums[4] += one * weight * value[b];
            sums[5] += one * vsqrt(seen.dx * seen.dx + seen.dy * seen.dy);
            count[b] += hit & 1;
            const i16 leads = hit & (weight > most[b]);
            most[b] = leads ? weight : most[b];
            who[b] = leads ? (i16)g : who[b];
            if (any(finished) && !any(T[b] > 0.0f)) open &= ~(1u << b);
        }
        *(v8*)(pair_sums + (long long)SUMS * k) = sum8(sums);
    }
    for (int y = 0; y < tile.rows; ++y)
        for (int x = 0; x < tile.columns; ++x) {
            const long long at = (long long)(tile.y0 + y) * width + tile.x0 + x;
            contributions[at] = count[y / 4 * 4 + x / 4][y % 4 * 4 + x % 4];
            strongest[at] = who[y / 4 * 4 + x / 4][y % 4 * 4 + x % 4];
        }
}
