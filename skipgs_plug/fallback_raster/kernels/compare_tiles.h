// |image - target| and 1 - SSIM summed over each tile, and the slopes of 1 - SSIM.
#include "loss_tiles.h"
const Rows rows(height, width, channels);
const int span = rows.span, reach = rows.reach, margin = rows.margin;
for (int item = first; item < last; ++item) {
    const LossTile tile(rows, item, height, image, target, offsets);
    const int top = tile.top, bottom = tile.bottom;
    const float *x = tile.x, *y = tile.y;
    const long long middle = (long long)(top + bottom) / 2 * span;
    v16 l1 = (v16)0.0f, unlike = (v16)0.0f;
    // The last WINDOW rows, blurred along themselves: x, d, x^2 + y^2 and d^2, all less the shifts.
    alignas(64) v16 ring[WINDOW][CHUNK][4];
    for (int row = top - RADIUS; row < bottom + RADIUS; ++row) {
        for (int vector = tile.first_vector; vector < tile.last_vector; ++vector) {
            const int i = 16 * vector;
            const v16 shift_x = tile.piece(x + middle, i), shift_y = tile.piece(y + middle, i);
            const v16 shift_d = shift_x - shift_y;
            v16* out = ring[(row + WINDOW) % WINDOW][vector - tile.first_vector];
            if (row < 0 || row >= height) {  // black
                out[0] = -shift_x;
                out[1] = -shift_d;
                out[2] = shift_x * shift_x + shift_y * shift_y;
                out[3] = shift_d * shift_d;
                continue;
            }
            const float *px = x + (long long)row * span + i - reach, *py = y + (long long)row * span + i - reach;
            float edge_x[16 + 2 * RADIUS * LOSS_CHANNELS], edge_y[16 + 2 * RADIUS * LOSS_CHANNELS];
            if (i < reach || i + 16 + reach > span) {
                for (int j = 0; j < 16 + 2 * reach; ++j) {
                    const bool inside = i - reach + j >= 0 && i - reach + j < span;
                    edge_x[j] = inside ? px[j] : 0.0f;
                    edge_y[j] = inside ? py[j] : 0.0f;
                }
                px = edge_x;
                py = edge_y;
            }
            if (row >= top && row < bottom) l1 += vabs(load(px + reach) - load(py + reach));
            v16 mean_x = (v16)0.0f, mean_d = mean_x, squares = mean_x, differences = mean_x;
            for (int k = 0; k < WINDOW; ++k) {
                const v16 a = load(px + k * channels) - shift_x, b = load(py + k * channels) - shift_y, d = a - b;
                const v16 wa = w[k] * a, wb = w[k] * b, wd = w[k] * d;
                mean_x += wa;
                mean_d += wd;
                squares += wa * a;
                squares += wb * b;
                differences += wd * d;
            }
            out[0] = mean_x;
            out[1] = mean_d;
            out[2] = squares;
            out[3] = differences;
        }
        const int centre = row - RADIUS;
        if (centre < top) continue;
        const v16* line[WINDOW];
        for (int k = 0; k < WINDOW; ++k) line[k] = ring[(row + 1 + k) % WINDOW][0];
        const bool row_counts = !valid || (centre >= RADIUS && centre < height - RADIUS);
        for (int vector = tile.first_vector; vector < tile.last_vector; ++vector) {
            const int i = 16 * vector;
            const v16 shift_x = tile.piece(x + middle, i), shift_d = shift_x - tile.piece(y + middle, i);
            v16 blur[4] = {(v16)0.0f, (v16)0.0f, (v16)0.0f, (v16)0.0f};
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 4; ++m) blur[m] += w[k] * line[k][4 * (vector - tile.first_vector) + m];
            const v16 column = lane + (float)i;
            const i16 counts = (column < (float)(valid ? span - reach : span)) & (column >= (float)(valid ? reach : 0))
                             & (i16)(row_counts ? -1 : 0);
            const v16 mean_x = blur[0] + shift_x, mean_d = blur[1] + shift_d, mean_y = mean_x - mean_d;
            const v16 shifted_y = blur[0] - blur[1];
            const v16 variances = vmax(blur[2] - blur[0] * blur[0] - shifted_y * shifted_y, (v16)0.0f);
            const v16 variance_d = vmax(blur[3] - blur[1] * blur[1], (v16)0.0f);
            const v16 b1 = 1.0f / (mean_x * mean_x + mean_y * mean_y + 1e-4f), b2 = 1.0f / (variances + 9e-4f);
            const v16 luminance = mean_d * mean_d * b1, structure = variance_d * b2;
            unlike += counts ? luminance + (1.0f - luminance) * structure : (v16)0.0f;
            if (!with_gradient) continue;
            // The gradient of 1 - SSIM is blur(rest) + (d - offset) blur(slope_d) + (x - 0.5) blur(slope_x).
            const v16 slope_d = 2.0f * b2 * (1.0f - luminance), slope_x = -structure * slope_d;
            const v16 rest = 2.0f * (1.0f - structure) * b1 * mean_d * (1.0f - mean_x * mean_d * b1)
                           - (mean_d - load(tile.offset + i)) * slope_d - (mean_x - 0.5f) * slope_x;
            float* out = slopes + (tile.start + centre) * 3 * pitch + margin + i;
            store(out, counts ? rest : (v16)0.0f);
            store(out + pitch, counts ? slope_d : (v16)0.0f);
            store(out + 2 * pitch, counts ? slope_x : (v16)0.0f);
            for (int m = 0; m < 3; ++m) {
                for (int j = 0; vector == 0 && j < margin; j += 16) store(out + m * pitch - margin + j, (v16)0.0f);
                for (int j = 16; vector == rows.vectors - 1 && j < 16 + margin; j += 16)
                    store(out + m * pitch + j, (v16)0.0f);
            }
        }
    }
    sums[2 * item] = sum(l1);
    sums[2 * item + 1] = sum(unlike);
}
