// Rows brought up to date by the steps without a gradient that they missed, and stepped with a gradient where there is one.
//
// To the bit what `adam.h` makes of the same steps, for rows of at most 48 floats. Its two divisions and square root take
// 35 cycles for 16 floats; where nothing comes near underflow they are multiply-adds that give the same correctly rounded
// results (Markstein, IBM J. Res. Dev. 34, 1990).
const auto fma = [](v16 a, v16 b, v16 c) INLINE -> v16 { return __builtin_elementwise_fma(a, b, c); };
const auto advance = [&](v16 g, v16& m, v16& s, v16& x, float rate, float root) INLINE {
#pragma clang fp contract(off)
    const v16 towards = g - m, kept = keep2 * s, added = take2 * g;
    m = fma((v16)take1, towards, m);
    s = fma(added, g, kept);
    m = vabs(m) < 1.17549435e-38f ? (v16)0.0f : m;
    x = x + -rate * m / (vsqrt(s) / root + eps);
};
constexpr int VECTORS = 3;
for (int i = first; i < last; ++i) {
    const int row = rows[i];
    if (done[row] < 0 && !all_rows) continue;
    const int begin = done[row] < 0 ? ~done[row] : done[row];
    if (begin == now && !with_gradient) continue;
    const long long at = (long long)row * width;
    float *m_row = mean + at, *s_row = square + at, *x_row = values + at, *g_row = gradient + (long long)i * width;
    float buffer[4][16];
    if (width < 16) {
        for (int j = 0; j < 16; ++j) {
            const bool there = j < width;
            buffer[0][j] = there ? m_row[j] : 0.0f;
            buffer[1][j] = there ? s_row[j] : 0.0f;
            buffer[2][j] = there ? x_row[j] : 0.0f;
            buffer[3][j] = there && with_gradient ? g_row[j] : 0.0f;
        }
        m_row = buffer[0], s_row = buffer[1], x_row = buffer[2], g_row = buffer[3];
    }
    // The last vectors overlap those before them: what lies in two is computed twice, and read before it is written.
    v16 m[VECTORS], s[VECTORS], x[VECTORS], g[VECTORS], half[VECTORS];
    i16 still[VECTORS];
    int offset[VECTORS];
    i16 alive = (i16)0;
    for (int v = 0; v < VECTORS; ++v) {
        offset[v] = larger(smaller(16 * v, width - 16), 0);
        m[v] = load(m_row + offset[v]);
        s[v] = load(s_row + offset[v]);
        x[v] = load(x_row + offset[v]);
        g[v] = with_gradient ? load(g_row + offset[v]) : (v16)0.0f;
        alive |= (m[v] != 0.0f) | (s[v] != 0.0f) | (g[v] != 0.0f);
    }
    if (!bits(alive)) {
        done[row] = ~(now + with_gradient);
        continue;
    }
    bool at_rest = false;
    int step = begin;
    while (step < now) {
#pragma clang fp contract(off)
        const int end = smaller(step + CHUNK, now);
        i16 moving = (i16)0, outside = (i16)0;
        for (int v = 0; v < VECTORS; ++v) {
            const v16 size = vabs(m[v]);
            still[v] = m[v] == 0.0f;
            outside |= ~still[v] & ~((size >= least_mean) & (size <= 0x1p40f) & (s[v] >= least_square) & (s[v] <= 0x1p60f));
            // A step shorter than a quarter of the distance to the next float changes nothing, nor do those that follow.
            const v16 longest = 0x1p20f * most_rate * size, least = 0x1p-7f * x[v];
            moving |= ~still[v] & ~(longest * longest < s[v] * (least * least));
        }
        if (!bits(moving) && !all_rows) {
            at_rest = true;
            break;
        }
        if (!bits(moving)) {
            for (; step < end; ++step)
                for (int v = 0; v < VECTORS; ++v) {
                    m[v] = fma((v16)-take1, m[v], m[v]);
                    m[v] = vabs(m[v]) < 1.17549435e-38f ? (v16)0.0f : m[v];
                    s[v] = keep2 * s[v];
                }
            continue;
        }
        if (bits(outside) || end - step == 1) {
            for (; step < end; ++step)
                for (int v = 0; v < VECTORS; ++v) advance((v16)0.0f, m[v], s[v], x[v], rates[step], roots[step]);
            continue;
        }
        // Half the inverse of the root, to 5e-6.
        for (int v = 0; v < VECTORS; ++v) {
            v16 y = (v16)(0x5f3759df - ((i16)s[v] >> 1));
            for (int k = 0; k < 2; ++k) y = y * fma(-0.5f * s[v] * y, y, (v16)1.5f);
            half[v] = 0.5f * y;
        }
        for (; step < end; ++step)
            for (int v = 0; v < VECTORS; ++v) {
                m[v] = fma((v16)-take1, m[v], m[v]);
                s[v] = keep2 * s[v];
                const v16 moved = -rates[step] * m[v];
                // The root: one Newton step for it and for its halved inverse, then the rounding.
                half[v] = half[v] * grow;
                v16 sq = (s[v] + s[v]) * half[v];
                const v16 error = fma(-sq, half[v], (v16)0.5f);
                const v16 finer = fma(half[v], error, half[v]);
                sq = fma(sq, error, sq);
                sq = fma(fma(-sq, sq, s[v]), finer, sq);
                // Divided by that of the bias correction.
                v16 below = sq * per_root[step];
                below = fma(fma((v16)-roots[step], below, sq), (v16)per_root[step], below) + eps;
                v16 inverse = finer * (2.0f * roots[step]);
                inverse = fma(inverse, fma(-below, inverse, (v16)1.0f), inverse);
                inverse = fma(inverse, fma(-below, inverse, (v16)1.0f), inverse);
                v16 by = moved * inverse;
                by = fma(fma(-below, by, moved), inverse, by);
                x[v] = still[v] ? x[v] : x[v] + by;
            }
    }
    done[row] = at_rest ? ~step : now + with_gradient;
    if (step == begin && !with_gradient) continue;
    if (with_gradient)
        for (int v = 0; v < VECTORS; ++v) advance(g[v], m[v], s[v], x[v], rates[now], roots[now]);
    for (int v = 0; v < VECTORS; ++v) {
        store(m_row + offset[v], m[v]);
        store(s_row + offset[v], s[v]);
        store(x_row + offset[v], x[v]);
    }
    if (width < 16)
        for (int j = 0; j < width; ++j) {
            mean[at + j] = m_row[j];
            square[at + j] = s_row[j];
            values[at + j] = x_row[j];
        }
}
