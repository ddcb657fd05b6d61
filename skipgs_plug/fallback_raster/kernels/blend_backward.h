// Adjoint of blend_forward, back to front, one tile at a time.
#include "blend_tile.h"
for (int t = first; t < last; ++t) {
    const Tile tile(t, tile_start, tiles_x, width, height);
    const int x0 = tile.x0, y0 = tile.y0;

    // behind = (the colour one would see without the current Gaussian and those before it) . v_image, so that it is not
    // divided by 1 - alpha; at the end of the list that is what alpha and background receive.
    alignas(64) v16 T[16], behind[16], v[16][D];
    alignas(64) i16 stop[16];
    for (int b = 0; b < 16; ++b) {
        T[b] = (v16)1.0f;
        behind[b] = (v16)0.0f;
        stop[b] = (i16)0;
        for (int c = 0; c < D; ++c) v[b][c] = (v16)0.0f;
    }
    for (int y = 0; y < tile.rows; ++y)
        for (int x = 0; x < tile.columns; ++x) {
            const long long at = (long long)(y0 + y) * width + x0 + x;
            const int b = y / 4 * 4 + x / 4, l = y % 4 * 4 + x % 4;
            T[b][l] = transmittance[at];
            behind[b][l] = v_transmittance[at];
            stop[b][l] = pixel_stop[at];
            for (int c = 0; c < channels; ++c) v[b][c][l] = v_image[at * stride + channel + c];
        }
    unsigned open = 0;  // blocks with incoming gradient
    for (int b = 0; b < 16; ++b) {
        i16 wanted = behind[b] != 0.0f;
        for (int c = 0; c < D; ++c) wanted |= v[b][c] != 0.0f;
        // A block without incoming gradient adds exact zeros.
        if (any(wanted) || !(shortcuts & ZERO_GRADIENT)) open |= 1u << b;
    }
    // The part of the list that was blended last comes first.
    for (int part = parts - 1; part >= 0; --part) {
        const int begin = part ? far_start[t] : tile.begin, tile_end = part ? far_stop[t] : tile_stop[t];
        int slot = slot_start[part * tiles_x * tiles_y + t + 1];
        for (int k = tile_end - 1; k >= begin; --k) {
            __builtin_prefetch(records + (long long)RECORD * tile_list[larger(k - 8, begin)]);
            if (!pair_blocks[k]) continue;
            unsigned todo = pair_blocks[k] & open;
            const float* r = records + (long long)RECORD * tile_list[k];
            v16 m[8], abs_x = (v16)0.0f, abs_y = (v16)0.0f, v_color[D];
            for (int j = 0; j < 8; ++j) m[j] = (v16)0.0f;
            for (int c = 0; c < D; ++c) v_color[c] = (v16)0.0f;
            for (; todo; todo &= todo - 1) {
                const int b = __builtin_ctz(todo);
                const Falloff seen(tile, b, r);

                const i16 hit = (seen.log2_alpha >= LOG2_ALPHA_MIN) & (stop[b] > k);
                const v16 full = exp2(seen.log2_alpha);
                const v16 alpha = hit ? vmin((v16)ALPHA_MAX, full) : (v16)0.0f;
                v16 shade = r[8] * v[b][0];
                for (int c = 1; c < D; ++c) shade += r[8 + c] * v[b][c];
                T[b] = T[b] * (1.0f / (1.0f - alpha));  // from behind the Gaussian to before it
                const v16 weight = alpha * T[b], less = behind[b] - shade;
                behind[b] = hit ? behind[b] - alpha * less : behind[b];
                // Where alpha is clamped, neither opacity nor shape moves it.
                const v16 v_sigma = (hit & (full <= ALPHA_MAX)) ? weight * less : (v16)0.0f;
                for (int c = 0; c < D; ++c) v_color[c] += weight * v[b][c];
                const v16 v_x = v_sigma * seen.dx, v_y = v_sigma * seen.dy;
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
            }
            float* out = v_pairs + (long long)PAIR * --slot;
            for (int c = 0; c < D && c < 2; ++c) m[6 + c] = v_color[c];
            *(v8*)out = sum8(m);
            for (int c = 2; c < 4; ++c) out[6 + c] = c < D ? sum(v_color[c < D ? c : 0]) : 0.0f;
            out[10] = ABSGRAD ? r[2] * sum(abs_x) : 0.0f;
            out[11] = ABSGRAD ? sum(abs_y) : 0.0f;
        }
    }
}
