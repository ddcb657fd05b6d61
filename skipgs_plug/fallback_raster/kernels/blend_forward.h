// Front-to-back compositing, one tile at a time, of at most COMPILED_CHANNELS channels.
//
// Reads the records and lists of its own tiles. Writes the pixels of these tiles and, for each pair, the patches that
// blended it. No other thread writes to these tiles.
#pragma once
#include "lib/blend_tile.h"
#include "lib/patches.h"
#include "lib/reached_patches.h"
#include "lib/sorted_tile.h"
// Gaussians of a group, whose patches are found before any is blended: one bit each of a 64-bit mask.
static constexpr int GROUP_SIZE = 64;
// Gaussians of a patch whose instruction chains are interleaved. With 2, 3, 5 or 6 the kernel took 13, 6, 36 and 5 %
// longer.
static constexpr int SIDE_BY_SIDE = 4;
typedef unsigned char bytes __attribute__((ext_vector_type(32)));
typedef bool b32 __attribute__((ext_vector_type(32)));
typedef unsigned some_masks __attribute__((ext_vector_type(TESTED_AT_ONCE)));
typedef unsigned char some_bytes __attribute__((ext_vector_type(TESTED_AT_ONCE)));
// Bit l of the result's word k is bit k of byte l.
static constexpr auto transpose_bits = [](const unsigned char* from, unsigned* words) INLINE {
    bytes a = *(const bytes*)from;
#pragma clang loop unroll(full)
    for (int k = 7; k >= 0; --k) {
        words[k] = __builtin_bit_cast(unsigned, __builtin_convertvector(a > 127, b32));
        a += a;
    }
};
static constexpr auto blend_forward = [](const Record* records, const TileLists& lists, const Pixels& pixels,
                                         const BlendedPairs& blended, const Grid& grid, const Channels& channels,
                                         const ListPart& part, int with_alpha, int optimizations, int first,
                                         int last) INLINE {
    for (int t = first; t < last; ++t) {
        const Tile tile(t, lists.tile_start, grid);
        if (part.continued && tile.begin == tile.end) {
            blended.tile_stop[t] = tile.begin;
            blended.tile_blended[t] = 0;
            continue;
        }
        const int begin = tile.begin, end = tile.end;
        SortedTile list(begin, lists.sorted ? begin : end, lists);

        alignas(64) vpatch P[PATCHES], T[PATCHES], C[PATCHES][COMPILED_CHANNELS];
        alignas(64) ipatch stop[PATCHES];
        unsigned open = 0;  // patches with an unfinished pixel
        for (int b = 0; b < PATCHES; ++b) {
            const ipatch inside = tile.inside(b);
            P[b] = inside ? (vpatch)1.0f : (vpatch)0.0f;
            T[b] = (vpatch)1.0f;
            for (int c = 0; c < COMPILED_CHANNELS; ++c) C[b][c] = (vpatch)0.0f;
            stop[b] = (ipatch)begin;
            if (any(inside)) open |= 1u << b;
        }
        // Continue an earlier pass. Its `pixel_stop` counts pairs of both passes, of which `before` lie in the earlier
        // one.
        if (part.continued) {
            for (int q = 0; q < TILE_QUADS; ++q) {
                const Quad quad(tile, q, grid.width);
                read_patches(pixels.image + channels.first, quad, channels.stride, channels.number, C[0], COMPILED_CHANNELS);
                read_patches(pixels.product_left, quad, 1, 1, P, 1);
                read_patches(pixels.transmittance, quad, 1, 1, T, 1);
                read_patches((const float*)pixels.pixel_stop, quad, 1, 1, (vpatch*)stop, 1);
            }
            for (int b = 0; b < PATCHES; ++b) {
                stop[b] -= part.before;
                if (!any(P[b] > TRANSMITTANCE_MIN)) open &= ~(1u << b);
            }
        }
        // Records are scattered in memory. They are prefetched one by one while the group before is processed, because
        // a core cannot keep as many loads in flight as a group has.
        const auto prefetch = [&](int k) INLINE { __builtin_prefetch(records + lists.tile_record[k]); };
        list.sort(GROUP_SIZE);
        for (int k = begin; k < smaller(begin + GROUP_SIZE, end); ++k) prefetch(k);
        int blended_here = 0;
        for (int base = begin; base < end && open; base += GROUP_SIZE) {
            alignas(64) Record group[GROUP_SIZE + 1];  // records of the group, and one of opacity zero as padding
            alignas(32) unsigned char reached[PATCHES / 8][GROUP_SIZE] = {};  // patches that each reaches, 8 to a byte
            const int count = smaller(GROUP_SIZE, end - base);
            list.sort(base - begin + 2 * GROUP_SIZE);
            const int listed = lists.sorted ? end : begin + list.done;
            clear((float*)(group + GROUP_SIZE), RECORD_FLOATS);
            group[GROUP_SIZE].log2_opacity = -100.0f;
            for (int j = 0; j < count; j += TESTED_AT_ONCE) {
                const Record* r[TESTED_AT_ONCE];
                alignas(some_masks) unsigned patches[TESTED_AT_ONCE];
                for (int g = 0; g < TESTED_AT_ONCE; ++g) {
                    const int k = base + j + g;
                    r[g] = records + lists.tile_record[smaller(k, listed - 1)];
                    store((float*)(group + j + g), load((const float*)r[g]));
                    prefetch(smaller(k + GROUP_SIZE, listed - 1));
                    patches[g] = ~0u;
                }
                if (optimizations & PATCH_BOUNDS) reached_patches(r, tile.x0, tile.y0, patches);
                for (int i = 0; i < PATCHES / 8; ++i)
                    *(some_bytes*)(reached[i] + j) = __builtin_convertvector(*(const some_masks*)patches >> 8 * i, some_bytes);
            }
            unsigned long long live[PATCHES];  // by patch: bit i is set if Gaussian i of the group reaches it
            const unsigned long long here = ~0ull >> (GROUP_SIZE - count);
            for (int i = 0; i < PATCHES / 8; ++i) {
                unsigned low[8], high[8];
                transpose_bits(reached[i], low);
                transpose_bits(reached[i] + 32, high);
                for (int b = 0; b < 8; ++b) live[8 * i + b] = (low[b] | (unsigned long long)high[b] << 32) & here;
            }
            const unsigned visited = open;
            for (unsigned todo = open; todo; todo &= todo - 1) {
                const int b = __builtin_ctz(todo);
                // Process several Gaussians at a time, step by step: a processor cannot look far enough ahead to
                // overlap the long chains of single Gaussians. The chain between Gaussians is short because the product
                // has no select in it: it also continues in finished pixels, where it falls below TRANSMITTANCE_MIN.
                vpatch product = P[b], transmitted = T[b], color[COMPILED_CHANNELS];
                ipatch stopped = stop[b];
                unsigned long long taken = 0;
                for (int c = 0; c < COMPILED_CHANNELS; ++c) color[c] = C[b][c];
                for (unsigned long long remaining = live[b]; remaining;) {
                    int member[SIDE_BY_SIDE];  // index in the group
                    const Record* r[SIDE_BY_SIDE];
                    vpatch t[SIDE_BY_SIDE], alpha[SIDE_BY_SIDE];
#pragma clang loop unroll(full)
                    for (int i = 0; i < SIDE_BY_SIDE; ++i) {
                        member[i] = remaining ? __builtin_ctzll(remaining) : GROUP_SIZE;
                        r[i] = group + member[i];
                        remaining &= remaining - 1;
                    }
#pragma clang loop unroll(full)
                    for (int i = 0; i < SIDE_BY_SIDE; ++i) t[i] = Falloff(tile, b, *r[i]).log2_alpha;
#pragma clang loop unroll(full)
                    for (int i = 0; i < SIDE_BY_SIDE; ++i)
                        alpha[i] = t[i] >= LOG2_ALPHA_MIN ? vmin((vpatch)ALPHA_MAX, exp2(t[i])) : (vpatch)0.0f;
#pragma clang loop unroll(full)
                    for (int i = 0; i < SIDE_BY_SIDE; ++i) {
                        const vpatch weight = alpha[i] * product;
                        product = product - weight;
                        const ipatch hit = (t[i] >= LOG2_ALPHA_MIN) & (product > TRANSMITTANCE_MIN);
                        // Select instead of multiplying by zero, so that a NaN colour stays in the pixels that it
                        // covers.
                        for (int c = 0; c < COMPILED_CHANNELS; ++c)
                            color[c] = hit ? color[c] + weight * r[i]->color[c] : color[c];
                        transmitted = hit ? product : transmitted;
                        stopped = hit ? (ipatch)(base + member[i] + 1) : stopped;
                        taken |= (unsigned long long)any(hit) << (member[i] & (GROUP_SIZE - 1));
                    }
                    if ((optimizations & SATURATION) && !any(product > TRANSMITTANCE_MIN)) {
                        open &= ~(1u << b);
                        break;
                    }
                    product = vmax(product, (vpatch)1e-20f);  // arithmetic on subnormal numbers is slow
                }
                P[b] = product;
                T[b] = transmitted;
                stop[b] = stopped;
                live[b] = taken;
                for (int c = 0; c < COMPILED_CHANNELS; ++c) C[b][c] = color[c];
            }
            // The patches in which each Gaussian was blended. The adjoint visits only these.
            alignas(32) unsigned char by_patch[GROUP_SIZE / 8][32] = {};
            for (unsigned todo = visited; todo; todo &= todo - 1) {
                const int b = __builtin_ctz(todo);
                for (int i = 0; i < GROUP_SIZE / 8; ++i) by_patch[i][b] = (unsigned char)(live[b] >> 8 * i);
            }
            for (int i = 0; 8 * i < count; ++i) {
                unsigned patches[8];
                transpose_bits(by_patch[i], patches);
                for (int j = 0; j < 8 && 8 * i + j < count; ++j) {
                    blended.pair_patches[base + 8 * i + j] = (int)patches[j];
                    blended_here += patches[j] != 0;
                }
            }
        }
        if (part.unfinished) pixels.still_open[t] = open != 0;
        int tile_end = begin;
        alignas(64) vpatch covered[PATCHES];
        for (int b = 0; b < PATCHES; ++b) {
            tile_end = larger(tile_end, __builtin_reduce_max(stop[b]));
            stop[b] += part.before;
            covered[b] = 1.0f - T[b];
        }
        blended.tile_stop[t] = tile_end;
        blended.tile_blended[t] = blended_here;
        for (int q = 0; q < TILE_QUADS; ++q) {
            const Quad quad(tile, q, grid.width);
            write_patches(pixels.image + channels.first, quad, channels.stride, channels.number, C[0], COMPILED_CHANNELS);
            write_patches(pixels.transmittance, quad, 1, 1, T, 1);
            if (with_alpha) write_patches(pixels.alpha, quad, 1, 1, covered, 1);
            write_patches((float*)pixels.pixel_stop, quad, 1, 1, (const vpatch*)stop, 1);
            if (part.unfinished) write_patches(pixels.product_left, quad, 1, 1, P, 1);
        }
    }
};
