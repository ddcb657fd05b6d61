// |image - target| and 1 - SSIM summed over each tile, and the gradient of the loss.
//
// A tile goes down its rows once. What the window needs of the rows above stays in two rings of WINDOW rows: x, d,
// x^2 + y^2 and d^2, all less the shifts and blurred along the row; and the slopes of 1 - SSIM, likewise blurred. Blurring
// both down the rows gives SSIM RADIUS rows later, and the gradient another RADIUS rows later.
static constexpr float w[WINDOW] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                                    0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
static constexpr int RADIUS = WINDOW / 2;
static constexpr int MOST = (RADIUS * LOSS_CHANNELS + 15) / 16;  // vectors that the window reaches to one side
static constexpr int AHEAD = WINDOW * 64;                        // rows above an image have numbers below zero

const int span = width * channels, vectors = (span + 15) / 16, reach = RADIUS * channels, side = (reach + 15) / 16;
const int bands = (height + BAND - 1) / BAND, chunks = (vectors + CHUNK - 1) / CHUNK;
// The gradient needs slopes beyond the tile, in rows and in vectors.
const int more_rows = with_gradient ? RADIUS : 0, more = with_gradient ? side : 0;
for (int item = first; item < last; ++item) {
    const int top = item / chunks % bands * BAND, bottom = smaller(top + BAND, height);
    const int begin = item % chunks * CHUNK, own = smaller(begin + CHUNK, vectors) - begin;
    const long long start = (long long)(item / chunks / bands) * height;  // first row of its image
    const float *x = image + start * span, *y = target + start * span;
    const int wide = own + 2 * more, all = wide + 2 * side;
    const int left = 16 * (begin - more);  // column of the first slope, and beyond by `side` vectors of the first pixel
    // Floats `i` to `i + 15` of a row, black beyond its ends.
    const auto piece = [&](const float* row, int i) INLINE -> v16 {
        if (i >= 0 && i + 16 <= span) return load(row + i);
        v16 a = (v16)0.0f;
        for (int j = larger(0, -i); j < 16 && i + j < span; ++j) a[j] = row[i + j];
        return a;
    };

    // What x and d are counted from: about their mean in the tile, by channel.
    alignas(64) float shift_x[16 * (CHUNK + 4 * MOST)], shift_d[16 * (CHUNK + 4 * MOST)];
    {
        float mean_x[LOSS_CHANNELS], mean_y[LOSS_CHANNELS], counted[LOSS_CHANNELS];
        for (int c = 0; c < channels; ++c) mean_x[c] = mean_y[c] = counted[c] = 0.0f;
        for (int vector = begin; vector < begin + own; ++vector) {
            v16 a = (v16)0.0f, b = a;
            for (int row = top; row < bottom; row += 8) {
                a += piece(x + (long long)row * span, 16 * vector);
                b += piece(y + (long long)row * span, 16 * vector);
            }
            for (int j = 0, c = 16 * vector % channels; j < 16 && 16 * vector + j < span; ++j) {
                mean_x[c] += a[j];
                mean_y[c] += b[j];
                counted[c] += (float)((bottom - top + 7) / 8);
                c = c + 1 < channels ? c + 1 : 0;
            }
        }
        for (int c = 0; c < channels; ++c) {
            const float share = counted[c] > 0.0f ? 1.0f / counted[c] : 0.0f;
            mean_x[c] *= share;
            mean_y[c] *= share;
        }
        const int column = left - 16 * side;
        for (int j = 0, c = (column + 64 * MOST * channels) % channels; j < 16 * all; ++j) {
            shift_x[j] = mean_x[c];
            shift_d[j] = mean_x[c] - mean_y[c];
            c = c + 1 < channels ? c + 1 : 0;
        }
    }

    v16 l1 = (v16)0.0f, unlike = (v16)0.0f;
    alignas(64) float maps[4][16 * (CHUNK + 4 * MOST)], slopes[3][16 * (CHUNK + 2 * MOST)];
    alignas(64) v16 blurred[WINDOW * (CHUNK + 2 * MOST) * 4], sloping[WINDOW * CHUNK * 3];
    for (int row = top - more_rows - RADIUS; row < bottom + more_rows + RADIUS; ++row) {
        const bool inside = row >= 0 && row < height;
        for (int vector = 0; vector < all; ++vector) {
            const int i = left + 16 * (vector - side);
            v16 a = (v16)0.0f, b = a;
            if (inside) {
                a = piece(x + (long long)row * span, i);
                b = piece(y + (long long)row * span, i);
            }
            if (row >= top && row < bottom && i >= 16 * begin && i < 16 * (begin + own)) l1 += vabs(a - b);
            const v16 from_x = load(shift_x + 16 * vector), from_d = load(shift_d + 16 * vector);
            const v16 d = a - b - from_d;
            a -= from_x;
            b = a - d;
            store(maps[0] + 16 * vector, a);
            store(maps[1] + 16 * vector, d);
            store(maps[2] + 16 * vector, a * a + b * b);
            store(maps[3] + 16 * vector, d * d);
        }
        for (int vector = 0; vector < wide; ++vector) {
            const int at = 16 * (vector + side) - reach;
            v16 along[4] = {(v16)0.0f, (v16)0.0f, (v16)0.0f, (v16)0.0f};
#pragma clang loop unroll(full)
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 4; ++m) along[m] += w[k] * load(maps[m] + at + k * channels);
            v16* out = blurred + ((row + AHEAD) % WINDOW * wide + vector) * 4;
            for (int m = 0; m < 4; ++m) out[m] = along[m];
        }

        const int centre = row - RADIUS;
        if (centre < top - more_rows) continue;
        const bool own_row = centre >= top && centre < bottom;
        const bool row_counts = centre >= (valid ? RADIUS : 0) && centre < (valid ? height - RADIUS : height);
        const v16* line[WINDOW];
        for (int k = 0; k < WINDOW; ++k) line[k] = blurred + (row + 1 + k + AHEAD) % WINDOW * wide * 4;
        for (int vector = 0; vector < wide; ++vector) {
            const int i = left + 16 * vector;
            v16 blur[4] = {(v16)0.0f, (v16)0.0f, (v16)0.0f, (v16)0.0f};
#pragma clang loop unroll(full)
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 4; ++m) blur[m] += w[k] * line[k][4 * vector + m];
            const v16 column = lane + (float)i;
            const i16 counts = (column < (float)(valid ? span - reach : span)) & (column >= (float)(valid ? reach : 0))
                             & (i16)(row_counts ? -1 : 0);
            const v16 mean_x = blur[0] + load(shift_x + 16 * (vector + side));
            const v16 mean_d = blur[1] + load(shift_d + 16 * (vector + side)), mean_y = mean_x - mean_d;
            const v16 shifted_y = blur[0] - blur[1];
            const v16 variances = vmax(blur[2] - blur[0] * blur[0] - shifted_y * shifted_y, (v16)0.0f);
            const v16 variance_d = vmax(blur[3] - blur[1] * blur[1], (v16)0.0f);
            const v16 below1 = mean_x * mean_x + mean_y * mean_y + 1e-4f, below2 = variances + 9e-4f;
            const v16 both = 1.0f / (below1 * below2), b1 = both * below2, b2 = both * below1;
            const v16 luminance = mean_d * mean_d * b1, structure = variance_d * b2;
            if (own_row && vector >= more && vector < more + own)
                unlike += counts ? luminance + (1.0f - luminance) * structure : (v16)0.0f;
            if (!with_gradient) continue;
            // The gradient of 1 - SSIM is blur(rest) + (d - shift_d) blur(slope_d) + (x - shift_x) blur(slope_x).
            const v16 slope_d = 2.0f * b2 * (1.0f - luminance), slope_x = -structure * slope_d;
            const v16 rest = 2.0f * (1.0f - structure) * b1 * mean_d * (1.0f - mean_x * mean_d * b1)
                           - blur[1] * slope_d - blur[0] * slope_x;
            store(slopes[0] + 16 * vector, counts ? rest : (v16)0.0f);
            store(slopes[1] + 16 * vector, counts ? slope_d : (v16)0.0f);
            store(slopes[2] + 16 * vector, counts ? slope_x : (v16)0.0f);
        }
        if (!with_gradient) continue;
        for (int vector = 0; vector < own; ++vector) {
            const int at = 16 * (vector + more) - reach;
            v16 along[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
#pragma clang loop unroll(full)
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 3; ++m) along[m] += w[k] * load(slopes[m] + at + k * channels);
            v16* out = sloping + ((centre + AHEAD) % WINDOW * CHUNK + vector) * 3;
            for (int m = 0; m < 3; ++m) out[m] = along[m];
        }

        const int done = centre - RADIUS;
        if (done < top) continue;
        for (int k = 0; k < WINDOW; ++k) line[k] = sloping + (centre + 1 + k + AHEAD) % WINDOW * CHUNK * 3;
        for (int vector = 0; vector < own; ++vector) {
            const int i = 16 * (begin + vector);
            v16 blur[3] = {(v16)0.0f, (v16)0.0f, (v16)0.0f};
#pragma clang loop unroll(full)
            for (int k = 0; k < WINDOW; ++k)
                for (int m = 0; m < 3; ++m) blur[m] += w[k] * line[k][3 * vector + m];
            const v16 a = piece(x + (long long)done * span, i), d = a - piece(y + (long long)done * span, i);
            const v16 sign = d > 0.0f ? (v16)1.0f : (d < 0.0f ? (v16)-1.0f : (v16)0.0f);
            const int at = 16 * (vector + more + side);
            const v16 v_unlike = blur[0] + (d - load(shift_d + at)) * blur[1] + (a - load(shift_x + at)) * blur[2];
            const v16 v = l1_weight * sign + ssim_weight * v_unlike;
            float* out = gradient + (start + done) * span + i;
            if (i + 16 <= span) store(out, v);
            else for (int j = 0; i + j < span; ++j) out[j] = v[j];
        }
    }
    sums[2 * item] = sum(l1);
    sums[2 * item + 1] = sum(unlike);
}
