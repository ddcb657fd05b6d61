// Front-to-back compositing, one tile at a time.
#include "blend_tile.h"
#include "reached_blocks.h"
#include "sorted_tile.h"
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);
    if (continued && tile.begin == tile.end) {
        tile_stop[t] = tile.begin;
        tile_blended[t] = 0;
        continue;
    }
    const int x0 = tile.x0, y0 = tile.y0, begin = tile.begin, end = tile.end;
    SortedTile list(begin, sorted ? begin : end, unsorted, buffer, tile_list, tile_place, pair_row, records);

    alignas(64) v16 P[16], T[16], C[16][D];
    alignas(64) i16 stop[16];
    unsigned open = 0;  // blocks with an unfinished pixel
    for (int b = 0; b < 16; ++b) {
        const i16 inside = (lane_x + 4 * (b & 3) < (float)tile.columns) & (lane_y + 4 * (b >> 2) < (float)tile.rows);
        P[b] = inside ? (v16)1.0f : (v16)0.0f;
        T[b] = (v16)1.0f;
        for (int c = 0; c < D; ++c) C[b][c] = (v16)0.0f;
        stop[b] = (i16)begin;
        if (any(inside)) open |= 1u << b;
    }
    // What lies behind the lists of an earlier pass: its places count from `before` on.
    if (continued) {
        for (int y = 0; y < tile.rows; ++y)
            for (int x = 0; x < tile.columns; ++x) {
                const long long at = (long long)(y0 + y) * width + x0 + x;
                const int b = y / 4 * 4 + x / 4, l = y % 4 * 4 + x % 4;
                P[b][l] = product_left[at];
                T[b][l] = transmittance[at];
                stop[b][l] = pixel_stop[at] - before;
                for (int c = 0; c < channels; ++c) C[b][c][l] = image[at * stride + channel + c];
            }
        for (int b = 0; b < 16; ++b)
            if (!any(P[b] > TRANSMITTANCE_MIN)) open &= ~(1u << b);
    }
    int blended_here = 0;
    for (int base = begin; base < end && open; base += 64) {
        alignas(64) float chunk[65 * RECORD];  // their records, and one that no pixel sees
        unsigned long long live[16] = {};  // by block, the Gaussians of these 64 that reach it
        const int count = smaller(64, end - base);
        list.sort(base - begin + 64);
        const int listed = sorted ? end : begin + list.done;
        clear(chunk + 64 * RECORD, RECORD);
        chunk[64 * RECORD + 5] = -100.0f;
        for (int j = 0; j < count; j += 16) {
            alignas(64) int reached[16] = {};
            for (int i = 0; i < 16 && j + i < count; i += 4) {
                const float* r[4];
                for (int g = 0; g < 4; ++g) {
                    const int k = base + j + i + g;
                    r[g] = records + (long long)RECORD * tile_list[smaller(k, listed - 1)];
                    store(chunk + RECORD * (j + i + g), load(r[g]));
                }
                const i16 blocks = shortcuts & BLOCK_BOUNDS ? reached_blocks(r, tile.x0, tile.y0) : (i16)65535;
                for (int g = 0; g < 4 && j + i + g < count; ++g) reached[i + g] = blocks[4 * g];
            }
            const i16 of_gaussian = *(const i16*)reached;
            for (int b = 0; b < 16; ++b) live[b] |= (unsigned long long)bits(of_gaussian & (1 << b)) << j;
        }
        const unsigned visited = open;
        for (unsigned todo = open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            // Several Gaussians at a time, step by step: a processor looks too few instructions ahead to find the next
            // Gaussian behind the long chain of one. What chains them is short: nothing is selected on the way of the
            // product, which goes on in finished pixels, below TRANSMITTANCE_MIN.
            v16 product = P[b], transmitted = T[b], color[D];
            i16 stopped = stop[b];
            unsigned long long blended = 0;
            for (int c = 0; c < D; ++c) color[c] = C[b][c];
            for (unsigned long long rest = live[b]; rest;) {
                int place[BATCH];
                const float* r[BATCH];
                v16 t[BATCH], alpha[BATCH];
                for (int i = 0; i < BATCH; ++i) {
                    place[i] = rest ? __builtin_ctzll(rest) : 64;
                    r[i] = chunk + RECORD * place[i];
                    rest &= rest - 1;
                }
                for (int i = 0; i < BATCH; ++i) t[i] = Falloff(tile, b, r[i]).log2_alpha;
                exp2s(t, alpha);
                for (int i = 0; i < BATCH; ++i)
                    alpha[i] = t[i] >= LOG2_ALPHA_MIN ? vmin((v16)ALPHA_MAX, alpha[i]) : (v16)0.0f;
                for (int i = 0; i < BATCH; ++i) {
                    const v16 weight = alpha[i] * product;
                    product = product - weight;
                    const i16 hit = (t[i] >= LOG2_ALPHA_MIN) & (product > TRANSMITTANCE_MIN);
                    // Selected, not multiplied by zero: a NaN colour stays in the pixels that it touches.
                    for (int c = 0; c < D; ++c) color[c] = hit ? color[c] + weight * r[i][8 + c] : color[c];
                    transmitted = hit ? product : transmitted;
                    stopped = hit ? (i16)(base + place[i] + 1) : stopped;
                    blended |= (unsigned long long)any(hit) << (place[i] & 63);
                }
                if ((shortcuts & SATURATION) && !any(product > TRANSMITTANCE_MIN)) {
                    open &= ~(1u << b);
                    break;
                }
                product = vmax(product, (v16)1e-20f);  // subnormal numbers are slow
            }
            P[b] = product;
            T[b] = transmitted;
            stop[b] = stopped;
            live[b] = blended;
            for (int c = 0; c < D; ++c) C[b][c] = color[c];
        }
        // The blocks in which it was blended: what the adjoint visits.
        for (int j = 0; j < count; j += 16) {
            i16 of_block;
            for (int b = 0; b < 16; ++b) of_block[b] = visited >> b & 1 ? (int)(live[b] >> j) & 65535 : 0;
            for (int i = 0; i < 16 && j + i < count; ++i) {
                const int blocks = pair_blocks[base + j + i] = bits(of_block & (1 << i));
                blended_here += blocks != 0;
            }
        }
    }
    if (unfinished) still_open[t] = open != 0;
    int tile_end = begin;
    for (int b = 0; b < 16; ++b) tile_end = larger(tile_end, __builtin_reduce_max(stop[b]));
    tile_stop[t] = tile_end;
    tile_blended[t] = blended_here;
    for (int y = 0; y < tile.rows; ++y)
        for (int x = 0; x < tile.columns; ++x) {
            const long long at = (long long)(y0 + y) * width + x0 + x;
            const int b = y / 4 * 4 + x / 4, l = y % 4 * 4 + x % 4;
            transmittance[at] = T[b][l];
            pixel_stop[at] = stop[b][l] + before;
            if (unfinished) product_left[at] = P[b][l];
            for (int c = 0; c < channels; ++c) image[at * stride + channel + c] = C[b][c][l];
        }
}
