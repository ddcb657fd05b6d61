// Applies to each listed row the steps with zero gradient that it missed, and then one step with a gradient if there is
// one.
//
// The result is bit-identical to that of `adam.h` for the same steps. A step of `adam.h` has two divisions and a square
// root, which take 35 cycles for 16 floats. Where no number comes near underflow, multiply-adds give the same correctly
// rounded results (Markstein, IBM J. Res. Dev. 34, 1990) in 15 cycles.
//
// Reads the missed steps and the factors of the gradient. Updates `done`, the parameter and the moments of the listed
// rows. No row is listed twice, so no other thread writes to it.
#pragma once
#include "lib/adam_step.h"
#include "lib/harmonics.h"
#if defined(__FMA__) || defined(__ARM_FEATURE_FMA)
static constexpr bool fused = true;
#else
static constexpr bool fused = false;  // without the instruction each fma is a function call
#endif
static constexpr auto fma = [](v16 a, v16 b, v16 c) INLINE -> v16 { return __builtin_elementwise_fma(a, b, c); };
// 0.5 / sqrt(s) with a relative error of 5e-6.
static constexpr auto half_inverse_root = [](v16 s) INLINE -> v16 {
    v16 y = (v16)(0x5f3759df - ((i16)s >> 1));
    for (int k = 0; k < 2; ++k) y = y * fma(-0.5f * s * y, y, (v16)1.5f);
    return 0.5f * y;
};
// The change of the parameter in one step with zero gradient. `half` is 0.5 / sqrt(s) with a relative error of 1e-5.
static constexpr auto distance = [](const MissedSteps& missed, float eps, v16 m, v16 s, v16 half, int step) INLINE -> v16 {
#pragma clang fp contract(off)
    const v16 moved = -missed.rates[step] * m;
    // The root and half its inverse: one Newton step for both, then a correction that rounds the root correctly.
    v16 root = (s + s) * half;
    const v16 error = fma(-root, half, (v16)0.5f);
    half = fma(half, error, half);
    root = fma(root, error, root);
    root = fma(fma(-root, root, s), half, root);
    // Divide by the root of the bias correction, whose inverse is known.
    const v16 inverse_correction = (v16)missed.inverse_roots[step];
    v16 below = root * inverse_correction;
    below = fma(fma((v16)-missed.roots[step], below, root), inverse_correction, below) + eps;
    // Two Newton steps give a correctly rounded inverse, which the correction in the last line requires.
    v16 inverse = half * (2.0f * missed.roots[step]);
    for (int k = 0; k < 2; ++k) inverse = fma(inverse, fma(-below, inverse, (v16)1.0f), inverse);
    const v16 quotient = moved * inverse;
    return fma(fma(-below, quotient, moved), inverse, quotient);
};
static constexpr int ROW_VECTORS = 3;  // vectors of 16 floats in a row: 45 coefficients of the higher bands at most
static_assert(ROW_VECTORS * 16 == 3 * (HIGHER_COEFFICIENTS + 1) && FACTOR_FLOATS == 4, "an outer product fills a row");
static constexpr auto catch_up = [](const int* rows, int* done, const GradientFactors& factors, const Moments& parameter,
                                    const MissedSteps& missed, const Decay& decay, const SafeRange& safe, int m, int n,
                                    int width, int first, int last) INLINE {
    const int now = missed.number, with_gradient = factors.given;
    alignas(64) float bands[16][16];  // values of the higher bands for the next 16 rows
    for (int i = first; i < last; ++i) {
        if (with_gradient && (i - first) % 16 == 0) {
            int next[16];
            for (int l = 0; l < 16; ++l) next[l] = smaller(i + l, last - 1);
            v16 direction[4], basis[17];
            gather4(factors.directions, next, direction);
            for (int band = 1; band < 17; ++band) basis[band] = (v16)0.0f;
            harmonics(direction[0], direction[1], direction[2], factors.degree, basis);
            transpose(basis + 1);
            for (int l = 0; l < 16; ++l) store(bands[l], basis[1 + l]);
        }
        const int row = rows[i], begin = done[row];
        if (begin == now && !with_gradient) continue;
        done[row] = now + with_gradient;
        const long long at = (long long)row * width;
        float *m_row = parameter.mean + at, *s_row = parameter.square + at, *x_row = parameter.values + at;
        alignas(64) v16 product[ROW_VECTORS];
        if (with_gradient) {
            const v4 color = *(const v4*)(factors.colors + (long long)FACTOR_FLOATS * i);
            const bool received = color.x != 0.0f || color.y != 0.0f || color.z != 0.0f;
            const v16 basis = received ? load(bands[(i - first) % 16]) : (v16)0.0f;
            // The three channels of a band are neighbours.
            interleave3(basis * color.x, basis * color.y, basis * color.z, (float*)product);
        }
        const float* g_row = (const float*)product;
        struct { float mean[16], square[16], values[16], gradient[16]; } padded;  // a row of fewer than 16 floats
        if (width < 16) {
            for (int j = 0; j < 16; ++j) {
                const bool inside = j < width;
                padded.mean[j] = inside ? m_row[j] : 0.0f;
                padded.square[j] = inside ? s_row[j] : 0.0f;
                padded.values[j] = inside ? x_row[j] : 0.0f;
                padded.gradient[j] = inside && with_gradient ? g_row[j] : 0.0f;
            }
            m_row = padded.mean, s_row = padded.square, x_row = padded.values, g_row = padded.gradient;
        }
        // The last vector overlaps the one before it. Shared floats are computed twice, and loaded before either is
        // stored.
        v16 m[ROW_VECTORS], s[ROW_VECTORS], x[ROW_VECTORS], g[ROW_VECTORS], half[ROW_VECTORS];
        i16 zero[ROW_VECTORS], some = (i16)0;
        int offset[ROW_VECTORS];
        for (int v = 0; v < ROW_VECTORS; ++v) {
            offset[v] = larger(smaller(16 * v, width - 16), 0);
            m[v] = load(m_row + offset[v]);
            s[v] = load(s_row + offset[v]);
            x[v] = load(x_row + offset[v]);
            g[v] = with_gradient ? load(g_row + offset[v]) : (v16)0.0f;
            // A load that spans two recent stores would have to wait for both: shuffle the registers instead.
            if (width == 45 && v == 2 && with_gradient)
                g[v] = __builtin_shufflevector(product[1], product[2],  //
                                               13, 14, 15, 16, 17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28);
            some |= (m[v] != 0.0f) | (s[v] != 0.0f) | (g[v] != 0.0f);
        }
        if (!bits(some)) continue;  // zero gradient and moments: nothing changes
        for (int step = begin; step < now;) {
#pragma clang fp contract(off)
            const int end = smaller(step + STEPS_PER_CHECK, now);
            i16 moving = (i16)0, extreme = (i16)0;
            for (int v = 0; v < ROW_VECTORS; ++v) {
                const v16 size = vabs(m[v]);
                zero[v] = m[v] == 0.0f;
                const i16 safe_mean = (size >= safe.least_mean) & (size <= safe.most_mean);
                const i16 safe_square = (s[v] >= safe.least_square) & (s[v] <= 0x1p20f);
                extreme |= ~zero[v] & ~(safe_mean & safe_square);
                // A step shorter than a quarter of the distance to the next float changes nothing, and later steps are
                // shorter.
                const v16 longest = 0x1p20f * (safe.longest_rate * size), least = 0x1p-7f * x[v];
                moving |= ~zero[v] & ~(longest * longest < s[v] * (least * least));
            }
            if (!bits(moving)) {
                for (; step < end; ++step)
                    for (int v = 0; v < ROW_VECTORS; ++v) {
                        v16 unmoved = (v16)0.0f;
                        adam_step(decay, (v16)0.0f, m[v], s[v], unmoved, 0.0f, 1.0f);
                    }
            } else if (!fused || bits(extreme) || end - step == 1) {
                for (; step < end; ++step)
                    for (int v = 0; v < ROW_VECTORS; ++v)
                        adam_step(decay, (v16)0.0f, m[v], s[v], x[v], missed.rates[step], missed.roots[step]);
            } else {
                for (int v = 0; v < ROW_VECTORS; ++v) half[v] = half_inverse_root(s[v]);
                for (; step < end; ++step)
                    for (int v = 0; v < ROW_VECTORS; ++v) {
                        m[v] = fma((v16)decay.take1, -m[v], m[v]);
                        s[v] = decay.keep2 * s[v];
                        half[v] = half[v] * safe.grow;
                        const v16 moved = x[v] + distance(missed, decay.eps, m[v], s[v], half[v], step);
                        x[v] = zero[v] ? x[v] : moved;
                    }
            }
        }
        if (with_gradient)
            for (int v = 0; v < ROW_VECTORS; ++v)
                adam_step(decay, g[v], m[v], s[v], x[v], missed.rates[now], missed.roots[now]);
        for (int v = 0; v < ROW_VECTORS; ++v) {
            store(m_row + offset[v], m[v]);
            store(s_row + offset[v], s[v]);
            store(x_row + offset[v], x[v]);
        }
        if (width >= 16) continue;
        for (int j = 0; j < width; ++j) {
            parameter.mean[at + j] = m_row[j];
            parameter.square[at + j] = s_row[j];
            parameter.values[at + j] = x_row[j];
        }
    }
};
