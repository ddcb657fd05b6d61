// Adjoint of blend_forward, back to front, one tile at a time.
#include "lib/blend_tile.h"
#include "lib/pixels.h"
struct Seen : Falloff {
    vblock full;  // alpha before it is clamped
    Seen(const Tile& tile, int block, const float* r) : Falloff(tile, block, r), full(exp2(log2_alpha)) {}
};
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);

    // behind = (the colour one would see without the current Gaussian and those before it) . v_image, so that it is not
    // divided by 1 - alpha; at the end of the list that is what alpha and background receive. All are 0 outside the image,
    // where no list has a Gaussian before place 0.
    alignas(64) vblock T[BLOCKS], behind[BLOCKS], v[BLOCKS][D];
    alignas(64) iblock stop[BLOCKS];
    for (int b = 0; b < BLOCKS; ++b) behind[b] = (vblock)0.0f;
    for (int q = 0; q < QUADS; ++q) {
        const Quad quad(tile, q, width);
        read_blocks(v_image + channel, quad, stride, channels, v[0], D);
        read_blocks(transmittance, quad, 1, 1, T, 1);
        if (with_transmittance) read_blocks(v_transmittance, quad, 1, 1, behind, 1);
        read_blocks((const float*)pixel_stop, quad, 1, 1, (vblock*)stop, 1);
    }
    unsigned open = 0;  // blocks with incoming gradient
    for (int b = 0; b < BLOCKS; ++b) {
        iblock wanted = behind[b] != 0.0f;
        for (int c = 0; c < D; ++c) wanted |= v[b][c] != 0.0f;
        // A block without incoming gradient adds exact zeros.
        if (any(wanted) || !(optimizations & ZERO_GRADIENT)) open |= 1u << b;
    }
    // The part of the list that was blended last comes first.
    for (int part = parts - 1; part >= 0; --part) {
        const int begin = part ? far_start[t] : tile.begin, tile_end = part ? far_stop[t] : tile_stop[t];
        const float* own = part ? far_records : records;
        int slot = slot_end[part * tiles_x * tiles_y + t];
        for (int k = tile_end - 1; k >= begin; --k) {
            __builtin_prefetch(own + (long long)RECORD * tile_list[larger(k - 8, begin)]);
            if (!pair_blocks[k]) continue;
            const float* r = own + (long long)RECORD * tile_list[k];
            vblock m[8], abs_x = (vblock)0.0f, abs_y = (vblock)0.0f, v_color[D];
            for (int j = 0; j < 8; ++j) m[j] = (vblock)0.0f;
            for (int c = 0; c < D; ++c) v_color[c] = (vblock)0.0f;
            unsigned todo = pair_blocks[k] & open;
            // What the next block sees is on its way while this one's chain of instructions waits for itself.
            int b = todo ? __builtin_ctz(todo) : 0;
            Seen seen(tile, b, r);
            while (todo) {
                todo &= todo - 1;
                const int following = todo ? __builtin_ctz(todo) : b;
                Seen then = seen;
                if (todo) then = Seen(tile, following, r);

                const iblock hit = (seen.log2_alpha >= LOG2_ALPHA_MIN) & (stop[b] > k);
                const vblock alpha = hit ? vmin((vblock)ALPHA_MAX, seen.full) : (vblock)0.0f;
                vblock shade = r[8] * v[b][0];
                for (int c = 1; c < D; ++c) shade += r[8 + c] * v[b][c];
                const vblock before = T[b] / (1.0f - alpha);  // from behind the Gaussian to before it
                // Zero where it was not blended: a store of some lanes only takes long on some processors.
                const vblock weight = alpha * before, less = hit ? behind[b] - shade : (vblock)0.0f;
                T[b] = before;
                behind[b] = behind[b] - alpha * less;
                // Where alpha is clamped, neither opacity nor shape moves it.
                const vblock v_sigma = seen.full <= ALPHA_MAX ? weight * less : (vblock)0.0f;
                for (int c = 0; c < D; ++c) v_color[c] += weight * v[b][c];
                const vblock v_x = v_sigma * seen.dx, v_y = v_sigma * seen.dy;
                m[0] += v_sigma;
                m[1] += v_x;
                m[2] += v_y;
                m[3] += v_x * seen.dx;
                m[4] += v_x * seen.dy;
                m[5] += v_y * seen.dy;
                if (ABSGRAD) {
                    abs_x += vabs(v_sigma * seen.p);
                    abs_y += vabs(v_sigma * (r[3] * seen.p + r[4] * seen.w));
                }
                seen = then;
                b = following;
            }
            pair_slot[tile_place[k]] = slot--;
            float* out = v_pairs + (long long)PAIR * slot;
            for (int c = 0; c < D && c < 2; ++c) m[6 + c] = v_color[c];
            *(v8*)out = sum8(m);
            for (int c = 2; c < 4; ++c) out[6 + c] = c < D ? sum(v_color[c < D ? c : 0]) : 0.0f;
            out[10] = ABSGRAD ? r[2] * sum(abs_x) : 0.0f;
            out[11] = ABSGRAD ? sum(abs_y) : 0.0f;
        }
    }
}
