// Front-to-back compositing, one tile at a time.
#include "lib/blend_tile.h"
#include "lib/pixels.h"
#include "lib/reached_blocks.h"
#include "lib/sorted_tile.h"
static constexpr int GROUP = 64;        // Gaussians at a time, one bit each
static constexpr int SIDE_BY_SIDE = 4;  // of these in the chains of one block
typedef unsigned char bytes __attribute__((ext_vector_type(32)));
typedef bool b32 __attribute__((ext_vector_type(32)));
typedef unsigned some_masks __attribute__((ext_vector_type(TESTED)));
typedef unsigned char some_bytes __attribute__((ext_vector_type(TESTED)));
// Bit l of the result's word k is bit k of byte l.
static constexpr auto turn = [](const unsigned char* from, unsigned* words) INLINE {
    bytes a = *(const bytes*)from;
#pragma clang loop unroll(full)
    for (int k = 7; k >= 0; --k) {
        words[k] = __builtin_bit_cast(unsigned, __builtin_convertvector(a > 127, b32));
        a += a;
    }
};
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);
    if (continued && tile.begin == tile.end) {
        tile_stop[t] = tile.begin;
        tile_blended[t] = 0;
        continue;
    }
    const int begin = tile.begin, end = tile.end;
    SortedTile list(begin, sorted ? begin : end, unsorted, buffer, tile_list, tile_place, pair_record);

    alignas(64) vblock P[BLOCKS], T[BLOCKS], C[BLOCKS][D];
    alignas(64) iblock stop[BLOCKS];
    unsigned open = 0;  // blocks with an unfinished pixel
    for (int b = 0; b < BLOCKS; ++b) {
        const iblock inside = tile.inside(b);
        P[b] = inside ? (vblock)1.0f : (vblock)0.0f;
        T[b] = (vblock)1.0f;
        for (int c = 0; c < D; ++c) C[b][c] = (vblock)0.0f;
        stop[b] = (iblock)begin;
        if (any(inside)) open |= 1u << b;
    }
    // What lies behind the lists of an earlier pass: its places count from `before` on.
    if (continued) {
        for (int q = 0; q < QUADS; ++q) {
            const Quad quad(tile, q, width);
            read_blocks(image + channel, quad, stride, channels, C[0], D);
            read_blocks(product_left, quad, 1, 1, P, 1);
            read_blocks(transmittance, quad, 1, 1, T, 1);
            read_blocks((const float*)pixel_stop, quad, 1, 1, (vblock*)stop, 1);
        }
        for (int b = 0; b < BLOCKS; ++b) {
            stop[b] -= before;
            if (!any(P[b] > TRANSMITTANCE_MIN)) open &= ~(1u << b);
        }
    }
    // A record lies anywhere. Those of a group are sent for one by one while the group before it is looked through: all at
    // once are more than a core can wait for.
    const auto send_for = [&](int k) INLINE { __builtin_prefetch(records + (long long)RECORD * tile_list[k]); };
    list.sort(GROUP);
    for (int k = begin; k < smaller(begin + GROUP, end); ++k) send_for(k);
    int blended_here = 0;
    for (int base = begin; base < end && open; base += GROUP) {
        alignas(64) float chunk[(GROUP + 1) * RECORD];              // their records, and one that no pixel sees
        alignas(32) unsigned char reached[BLOCKS / 8][GROUP] = {};  // the blocks that each reaches, eight to a byte
        const int count = smaller(GROUP, end - base);
        list.sort(base - begin + 2 * GROUP);
        const int listed = sorted ? end : begin + list.done;
        clear(chunk + GROUP * RECORD, RECORD);
        chunk[GROUP * RECORD + 5] = -100.0f;
        for (int j = 0; j < count; j += TESTED) {
            const float* r[TESTED];
            alignas(some_masks) unsigned blocks[TESTED];
            for (int g = 0; g < TESTED; ++g) {
                const int k = base + j + g;
                r[g] = records + (long long)RECORD * tile_list[smaller(k, listed - 1)];
                store(chunk + RECORD * (j + g), load(r[g]));
                send_for(smaller(k + GROUP, listed - 1));
                blocks[g] = ~0u;
            }
            if (optimizations & BLOCK_BOUNDS) reached_blocks(r, tile.x0, tile.y0, blocks);
            for (int i = 0; i < BLOCKS / 8; ++i)
                *(some_bytes*)(reached[i] + j) = __builtin_convertvector(*(const some_masks*)blocks >> 8 * i, some_bytes);
        }
        unsigned long long live[BLOCKS];  // by block, the Gaussians of the group that reach it
        const unsigned long long here = ~0ull >> (GROUP - count);
        for (int i = 0; i < BLOCKS / 8; ++i) {
            unsigned low[8], high[8];
            turn(reached[i], low);
            turn(reached[i] + 32, high);
            for (int b = 0; b < 8; ++b) live[8 * i + b] = (low[b] | (unsigned long long)high[b] << 32) & here;
        }
        const unsigned visited = open;
        for (unsigned todo = open; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            // Several Gaussians at a time, step by step: a processor looks too few instructions ahead to find the next
            // Gaussian behind the long chain of one. What chains them is short: nothing is selected on the way of the
            // product, which goes on in finished pixels, below TRANSMITTANCE_MIN.
            vblock product = P[b], transmitted = T[b], color[D];
            iblock stopped = stop[b];
            unsigned long long blended = 0;
            for (int c = 0; c < D; ++c) color[c] = C[b][c];
            for (unsigned long long rest = live[b]; rest;) {
                int place[SIDE_BY_SIDE];
                const float* r[SIDE_BY_SIDE];
                vblock t[SIDE_BY_SIDE], alpha[SIDE_BY_SIDE];
#pragma clang loop unroll(full)
                for (int i = 0; i < SIDE_BY_SIDE; ++i) {
                    place[i] = rest ? __builtin_ctzll(rest) : GROUP;
                    r[i] = chunk + RECORD * place[i];
                    rest &= rest - 1;
                }
#pragma clang loop unroll(full)
                for (int i = 0; i < SIDE_BY_SIDE; ++i) t[i] = Falloff(tile, b, r[i]).log2_alpha;
#pragma clang loop unroll(full)
                for (int i = 0; i < SIDE_BY_SIDE; ++i)
                    alpha[i] = t[i] >= LOG2_ALPHA_MIN ? vmin((vblock)ALPHA_MAX, exp2(t[i])) : (vblock)0.0f;
#pragma clang loop unroll(full)
                for (int i = 0; i < SIDE_BY_SIDE; ++i) {
                    const vblock weight = alpha[i] * product;
                    product = product - weight;
                    const iblock hit = (t[i] >= LOG2_ALPHA_MIN) & (product > TRANSMITTANCE_MIN);
                    // Selected, not multiplied by zero: a NaN colour stays in the pixels that it touches.
                    for (int c = 0; c < D; ++c) color[c] = hit ? color[c] + weight * r[i][8 + c] : color[c];
                    transmitted = hit ? product : transmitted;
                    stopped = hit ? (iblock)(base + place[i] + 1) : stopped;
                    blended |= (unsigned long long)any(hit) << (place[i] & (GROUP - 1));
                }
                if ((optimizations & SATURATION) && !any(product > TRANSMITTANCE_MIN)) {
                    open &= ~(1u << b);
                    break;
                }
                product = vmax(product, (vblock)1e-20f);  // subnormal numbers are slow
            }
            P[b] = product;
            T[b] = transmitted;
            stop[b] = stopped;
            live[b] = blended;
            for (int c = 0; c < D; ++c) C[b][c] = color[c];
        }
        // The blocks in which each was blended: what the adjoint visits.
        alignas(32) unsigned char by_block[GROUP / 8][32] = {};
        for (unsigned todo = visited; todo; todo &= todo - 1) {
            const int b = __builtin_ctz(todo);
            for (int i = 0; i < GROUP / 8; ++i) by_block[i][b] = (unsigned char)(live[b] >> 8 * i);
        }
        for (int i = 0; 8 * i < count; ++i) {
            unsigned blocks[8];
            turn(by_block[i], blocks);
            for (int j = 0; j < 8 && 8 * i + j < count; ++j) {
                pair_blocks[base + 8 * i + j] = (int)blocks[j];
                blended_here += blocks[j] != 0;
            }
        }
    }
    if (unfinished) still_open[t] = open != 0;
    int tile_end = begin;
    alignas(64) vblock covered[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) {
        tile_end = larger(tile_end, __builtin_reduce_max(stop[b]));
        stop[b] += before;
        covered[b] = 1.0f - T[b];
    }
    tile_stop[t] = tile_end;
    tile_blended[t] = blended_here;
    for (int q = 0; q < QUADS; ++q) {
        const Quad quad(tile, q, width);
        write_blocks(image + channel, quad, stride, channels, C[0], D);
        write_blocks(transmittance, quad, 1, 1, T, 1);
        if (with_alpha) write_blocks(alpha, quad, 1, 1, covered, 1);
        write_blocks((float*)pixel_stop, quad, 1, 1, (const vblock*)stop, 1);
        if (unfinished) write_blocks(product_left, quad, 1, 1, P, 1);
    }
}
