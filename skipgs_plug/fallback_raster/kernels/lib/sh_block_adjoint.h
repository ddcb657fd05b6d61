// Adjoint of sh_forward for one block of rows: 16 rows that received a gradient at a time.
#pragma once
#include "sh.h"

// With `with_position`, `v_position` receives this block's part of the gradient of the camera's position. With
// `v_sh.factored`, the gradient of the higher bands goes to `factors`, one row for each visible Gaussian. This function
// is inlined, so callers that pass constant flags drop the other cases.
static constexpr auto sh_block_adjoint =
    [](int block, const float* means, const Harmonics& sh, const RowList& visible, const float* colors, const float* v_colors,
       float* v_means, const HarmonicsGradients& v_sh, const FactorOutput& factors, float* v_position, int n,
       bool with_position, int optimizations) INLINE {
    const int degree = sh.degree, factored = v_sh.factored;
    float position_sum[3] = {0.0f, 0.0f, 0.0f};
    // Clear one block at a time, so that it is still in the cache when the gradients are written.
    const long long row_begin = (long long)BLOCK_ROWS * block;
    const int rows = smaller(BLOCK_ROWS, n - (int)row_begin);
    const int begin = visible.block_start[block], listed = visible.block_start[block + 1] - begin;
    const bool empty = listed == 0;
    const auto clear_rows = [=](float* p, long long n) { empty ? clear_past_caches(p, n) : clear(p, n); };
    clear_rows(v_means + 3 * row_begin, 3 * rows);
    clear_rows(v_sh.sh0 + sh.sh0_stride * row_begin, sh.sh0_stride * rows);
    const bool with_factors = factored && degree > 0;
    if (with_factors) clear(factors.colors + (long long)FACTOR_FLOATS * begin, FACTOR_FLOATS * listed);
    else if (!factored && v_sh.shN != v_sh.sh0) clear_rows(v_sh.shN + sh.shN_stride * row_begin, sh.shN_stride * rows);
    const int terms = (degree + 1) * (degree + 1);
    int received[BLOCK_ROWS], target[BLOCK_ROWS], count = 0;  // rows, destination rows of their gradients, number of both
    for (int i = begin; i < begin + listed; ++i) {
        // A row has no gradient where its colour was clamped at zero, and where no pixel blended it.
        const int g = visible.rows[i];
        bool any = !(optimizations & CONTRIBUTED_ONLY);
        for (int k = 0; k < 3; ++k) any |= (colors[3 * g + k] > 0.0f) & (v_colors[3 * g + k] != 0.0f);
        if (any && count < 16) fetch_bands(sh, g);
        received[count] = g;
        target[count] = factored ? i : g;
        count += any;
    }
    for (int i = 0; i < count; i += 16) {
        const int lanes = smaller(16, count - i);
        int row[16];
        next_rows(received + i, lanes, row);
        for (int l = 0; l < 16; ++l)
            fetch_bands(sh, received[smaller(i + 16 + l, count - 1)]);
        v16 color[3], v[3];
        gather3(colors, row, n, color);
        gather3(v_colors, row, n, v);
        for (int k = 0; k < 3; ++k) v[k] = color[k] > 0.0f ? v[k] : (v16)0.0f;
        const Directions d = directions(means, row, n, sh.position);
        const v16 x = d.x, y = d.y, z = d.z;
        const v16 xx = x * x, yy = y * y, zz = z * z;
        const v16 v_constant[3] = {CONSTANT_BASIS * v[0], CONSTANT_BASIS * v[1], CONSTANT_BASIS * v[2]};
        if (sh.sh0_stride == 3) scatter3(v_sh.sh0, row, v_constant[0], v_constant[1], v_constant[2], lanes);
        else put_bands(v_sh.sh0, row, sh.sh0_stride, 3, v_constant, lanes);
        if (with_factors) {
            scatter4(factors.directions, target + i, x, y, z, (v16)0.0f, lanes);
            scatter4(factors.colors, target + i, v[0], v[1], v[2], (v16)0.0f, lanes);
        } else if (!factored) {
            v16 basis[16], v_bands[48];
            harmonics(x, y, z, degree, basis);
            for (int band = 1; band < terms; ++band)
                for (int k = 0; k < 3; ++k) v_bands[3 * band - 3 + k] = basis[band] * v[k];
            put_bands(v_sh.shN + sh.shN_offset, target + i, sh.shN_stride, 3 * (terms - 1), v_bands, lanes);
        }
        if (degree == 0) continue;
        v16 bands[48], along[16];
        take_bands(sh.shN + sh.shN_offset, row, sh.shN_stride, 3 * (terms - 1), bands);
        for (int band = 1; band < terms; ++band)
            along[band] = bands[3 * band - 3] * v[0] + bands[3 * band - 2] * v[1] + bands[3 * band - 1] * v[2];
        v16 vx = -0.4886025119029199f * along[3], vy = -0.4886025119029199f * along[1];
        v16 vz = 0.4886025119029199f * along[2];
        if (degree > 1) {
            vx += 1.0925484305920792f * (y * along[4] - z * along[7] + x * along[8]) - 0.6307831305050401f * x * along[6];
            vy += 1.0925484305920792f * (x * along[4] - z * along[5] - y * along[8]) - 0.6307831305050401f * y * along[6];
            vz += -1.0925484305920792f * (y * along[5] + x * along[7]) + 1.2615662610100802f * z * along[6];
        }
        if (degree > 2) {
            vx += -3.540261539559861f * x * y * along[9] + 2.890611442640554f * y * z * along[10]
                + 0.9140915989289316f * x * y * along[11] - 2.2390579955406924f * x * z * along[12]
                - 0.4570457994644658f * (4.0f * zz - 3.0f * xx - yy) * along[13] + 2.890611442640554f * x * z * along[14]
                - 1.7701307697799304f * (xx - yy) * along[15];
            vy += -1.7701307697799304f * (xx - yy) * along[9] + 2.890611442640554f * x * z * along[10]
                - 0.4570457994644658f * (4.0f * zz - xx - 3.0f * yy) * along[11] - 2.2390579955406924f * y * z * along[12]
                + 0.9140915989289316f * x * y * along[13] - 2.890611442640554f * y * z * along[14]
                + 3.540261539559861f * x * y * along[15];
            vz += 2.890611442640554f * x * y * along[10] - 3.6563663957157264f * z * (y * along[11] + x * along[13])
                + 1.1195289977703462f * (2.0f * zz - xx - yy) * along[12] + 1.445305721320277f * (xx - yy) * along[14];
        }
        // Adjoint of the normalisation of the direction.
        const v16 back = d.norm * d.shrink;
        // One of the two products is rounded before the sum: which one differs with and without the camera's gradient.
        // Clang used to choose so in the two kernels; the choice is kept because it keeps gradients equal to the bit.
        const v16 radial = with_position ? vx * x + rounded_product(vy, y) + vz * z
                                         : rounded_product(vx, x) + vy * y + vz * z;
        const v16 v_direction[3] = {(vx - radial * x) * back, (vy - radial * y) * back, (vz - radial * z) * back};
        scatter3(v_means, row, v_direction[0], v_direction[1], v_direction[2], lanes);
        if (!with_position) continue;
        alignas(64) float moved[3][16];
        for (int k = 0; k < 3; ++k) *(v16*)moved[k] = v_direction[k];
        for (int l = 0; l < lanes; ++l)
            for (int k = 0; k < 3; ++k) position_sum[k] -= moved[k][l];
    }
    if (with_position)
        for (int k = 0; k < 3; ++k) v_position[k] = position_sum[k];
};
