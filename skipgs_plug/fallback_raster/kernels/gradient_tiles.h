// Gradient of the loss: the blurred slopes of 1 - SSIM, and the sign of the difference.
#include "loss_tiles.h"
const Rows rows(height, width, channels);
const int span = rows.span, reach = rows.reach, margin = rows.margin;
for (int item = first; item < last; ++item) {
    const LossTile tile(rows, item, height, image, target, offsets);
    const int top = tile.top, bottom = tile.bottom;
    const float *x = tile.x, *y = tile.y;
    alignas(64) v16 ring[WINDOW][CHUNK][3];
    for (int row = top - RADIUS; row < bottom + RADIUS; ++row) {
        for (int vector = tile.first_vector; vector < tile.last_vector; ++vector) {
            v16* out = ring[(row + WINDOW) % WINDOW][vector - tile.first_vector];
            const float* from = slopes + (tile.start + row) * 3 * pitch + margin + 16 * vector - reach;
            v16 v[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
            if (row >= 0 && row < height)
                for (int k = 0; k < WINDOW; ++k)
                    for (int m = 0; m < 3; ++m) v[m] += w[k] * load(from + m * pitch + k * channels);
            for (int m = 0; m < 3; ++m) out[m] = v[m];
        }
        const int centre = row - RADIUS;
        if (centre < top) continue;
        const v16* line[WINDOW];
        for (int k = 0; k < WINDOW; ++k) line[k] = ring[(row + 1 + k) % WINDOW][0];
        for (int vector = tile.first_vector; vector < tile.last_vector; ++vector) {
            const int i = 16 * vector;
            v16 blur[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 3; ++m) blur[m] += w[k] * line[k][3 * (vector - tile.first_vector) + m];
            const long long row_start = (long long)centre * span;
            const v16 a = tile.piece(x + row_start, i), d = a - tile.piece(y + row_start, i);
            const v16 sign = d > 0.0f ? (v16)1.0f : (d < 0.0f ? (v16)-1.0f : (v16)0.0f);
            const v16 v_unlike = blur[0] + (d - load(tile.offset + i)) * blur[1] + (a - 0.5f) * blur[2];
            const v16 v = l1_weight * sign + ssim_weight * v_unlike;
            float* out = gradient + tile.start * span + row_start + i;
            if (i + 16 <= span) store(out, v);
            else for (int j = 0; i + j < span; ++j) out[j] = v[j];
        }
    }
}
