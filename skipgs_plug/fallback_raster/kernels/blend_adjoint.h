// Adjoint of blend_forward: one tile at a time, back to front, of at most COMPILED_CHANNELS channels.
//
// Reads the blended part of the lists of its own tiles, and the gradients of their pixels. Writes the sums of each
// blended pair to a slot that belongs to the pair, and the number of that slot. No other thread writes to these slots.
#pragma once
#include "lib/blend_tile.h"
#include "lib/patches.h"
// One Gaussian in one patch, as the adjoint sees it.
struct Visit : Falloff {
    vpatch full;  // alpha before the clamp to ALPHA_MAX
    Visit(const Tile& tile, int patch, const Record& r) : Falloff(tile, patch, r), full(exp2(log2_alpha)) {}
};
static constexpr auto blend_adjoint = [](const BlendedList& near, const BlendedList& far, const BackwardPairs& pairs,
                                         const FinalPixels& pixels, const PixelGradients& v_pixels, const PairSlots& slots,
                                         const Grid& grid, const Channels& channels, int with_transmittance,
                                         int optimizations, int first, int last) INLINE {
    for (int t = first; t < last; ++t) {
        const Tile tile(t, near.tile_start, grid);

        // behind = v_image . (the colour that a pixel would show without this Gaussian and all Gaussians in front of
        // it). Keeping this product avoids a division by 1 - alpha. At the end of the list it is the gradient that
        // alpha and background receive. All values are 0 outside the image, where every list is empty.
        alignas(64) vpatch T[PATCHES], behind[PATCHES], v[PATCHES][COMPILED_CHANNELS];
        alignas(64) ipatch stop[PATCHES];
        for (int b = 0; b < PATCHES; ++b) behind[b] = (vpatch)0.0f;
        for (int q = 0; q < TILE_QUADS; ++q) {
            const Quad quad(tile, q, grid.width);
            read_patches(v_pixels.image + channels.first, quad, channels.stride, channels.number, v[0], COMPILED_CHANNELS);
            read_patches(pixels.transmittance, quad, 1, 1, T, 1);
            if (with_transmittance) read_patches(v_pixels.transmittance, quad, 1, 1, behind, 1);
            read_patches((const float*)pixels.pixel_stop, quad, 1, 1, (vpatch*)stop, 1);
        }
        unsigned open = 0;  // bit b: some pixel of patch b has a gradient
        for (int b = 0; b < PATCHES; ++b) {
            ipatch wanted = behind[b] != 0.0f;
            for (int c = 0; c < COMPILED_CHANNELS; ++c) wanted |= v[b][c] != 0.0f;
            // A patch whose gradients are all zero would add exact zeros.
            if (any(wanted) || !(optimizations & ZERO_GRADIENT)) open |= 1u << b;
        }
        // Back to front: the part that was blended last comes first.
        for (int part = pairs.parts - 1; part >= 0; --part) {
            const Record* const records = part ? far.records : near.records;
            const int begin = part ? far.tile_start[t] : tile.begin;
            const int tile_end = part ? far.tile_stop[t] : near.tile_stop[t];
            int slot = pairs.slot_end[part * grid.tiles_x * grid.tiles_y + t];
            for (int k = tile_end - 1; k >= begin; --k) {
                __builtin_prefetch(records + pairs.tile_record[larger(k - 8, begin)]);
                if (!pairs.pair_patches[k]) continue;
                const Record& r = records[pairs.tile_record[k]];
                vpatch m[8], abs_x = (vpatch)0.0f, abs_y = (vpatch)0.0f, v_color[COMPILED_CHANNELS];
                for (int j = 0; j < 8; ++j) m[j] = (vpatch)0.0f;
                for (int c = 0; c < COMPILED_CHANNELS; ++c) v_color[c] = (vpatch)0.0f;
                // Broadcast each channel to all lanes once. Otherwise Clang keeps the channels packed in one register
                // and unpacks them again for every patch.
                vpatch color[COMPILED_CHANNELS];
                for (int c = 0; c < COMPILED_CHANNELS; ++c) color[c] = (vpatch)r.color[c];
                unsigned todo = pairs.pair_patches[k] & open;
                // Start the arithmetic of the next patch now: it runs while this patch's chain of dependent
                // instructions waits.
                int b = todo ? __builtin_ctz(todo) : 0;
                Visit visit(tile, b, r);
                while (todo) {
                    todo &= todo - 1;
                    const int following = todo ? __builtin_ctz(todo) : b;
                    Visit then = visit;
                    if (todo) then = Visit(tile, following, r);

                    const ipatch hit = (visit.log2_alpha >= LOG2_ALPHA_MIN) & (stop[b] > k);
                    const vpatch alpha = hit ? vmin((vpatch)ALPHA_MAX, visit.full) : (vpatch)0.0f;
                    vpatch shade = color[0] * v[b][0];
                    for (int c = 1; c < COMPILED_CHANNELS; ++c) shade += color[c] * v[b][c];
                    const vpatch before = T[b] / (1.0f - alpha);  // transmittance in front of the Gaussian
                    // Zero where the Gaussian was not blended. Masked stores are slow on some processors.
                    const vpatch weight = alpha * before, less = hit ? behind[b] - shade : (vpatch)0.0f;
                    T[b] = before;
                    behind[b] = behind[b] - alpha * less;
                    // Where alpha is clamped, its derivative by opacity and shape is zero.
                    const vpatch v_sigma = visit.full <= ALPHA_MAX ? weight * less : (vpatch)0.0f;
                    for (int c = 0; c < COMPILED_CHANNELS; ++c) v_color[c] += weight * v[b][c];
                    const vpatch v_x = v_sigma * visit.dx, v_y = v_sigma * visit.dy;
                    m[OF_1] += v_sigma;
                    m[OF_X] += v_x;
                    m[OF_Y] += v_y;
                    m[OF_XX] += v_x * visit.dx;
                    m[OF_XY] += v_x * visit.dy;
                    m[OF_YY] += v_y * visit.dy;
                    if (ABSGRAD) {
                        abs_x += vabs(v_sigma * visit.p);
                        // One of the two products is rounded before the sum: which one differs between one channel and
                        // more. Clang used to choose so; the choice is kept because it keeps gradients equal to the
                        // bit.
                        const vpatch along_y = COMPILED_CHANNELS == 1 ? r.slant * visit.p + rounded_product(r.across, visit.w)
                                                      : rounded_product(r.slant, visit.p) + r.across * visit.w;
                        abs_y += vabs(v_sigma * along_y);
                    }
                    visit = then;
                    b = following;
                }
                slots.pair_slot[pairs.tile_pair[k]] = slot--;
                PairSum& out = slots.sums[slot];
                // One folded sum gives six moments and the first two channels.
                static_assert(__builtin_offsetof(PairSum, color) == MOMENTS * sizeof(float), "the channels follow the moments");
                for (int c = 0; c < COMPILED_CHANNELS && c < 2; ++c) m[MOMENTS + c] = v_color[c];
                *(v8*)out.moment = sum8(m);
                for (int c = 2; c < MAX_CHANNELS; ++c)
                    out.color[c] = c < COMPILED_CHANNELS ? sum(v_color[c < COMPILED_CHANNELS ? c : 0]) : 0.0f;
                out.absolute[0] = ABSGRAD ? r.along * sum(abs_x) : 0.0f;
                out.absolute[1] = ABSGRAD ? sum(abs_y) : 0.0f;
            }
        }
    }
};
