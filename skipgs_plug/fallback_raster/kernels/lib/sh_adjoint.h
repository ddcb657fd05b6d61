// Adjoint of sh_forward for one block of rows, 16 of those that received a gradient at a time.
#include "sh_basis.h"
const int block = first;
float camera_sum[3] = {0.0f, 0.0f, 0.0f};
// Cleared here and not all at once, so that the memory is still in the cache when the gradients follow.
const long long row_begin = (long long)BLOCK * block;
const int rows = smaller(BLOCK, n - (int)row_begin);
const int listed = block_start[block + 1] - block_start[block];
const bool empty = listed == 0;
const auto clear_rows = [=](float* p, long long n) { empty ? clear_past_caches(p, n) : clear(p, n); };
clear_rows(v_means + 3 * row_begin, 3 * rows);
clear_rows(v_base + base_stride * row_begin, base_stride * rows);
const bool factors = OUTER && degree > 0;
if (factors) clear(factor_colors + (long long)FACTOR * block_start[block], FACTOR * listed);
else if (!OUTER && v_rest != v_base) clear_rows(v_rest + rest_stride * row_begin, rest_stride * rows);
const int terms = (degree + 1) * (degree + 1), begin = block_start[block];
int received[BLOCK], place[BLOCK], count = 0;
for (int i = begin; i < begin + listed; ++i) {
    // Where the colour was clamped at zero, and where nothing blended the Gaussian, there is no gradient.
    const int g = visible[i];
    bool any = !(optimizations & CONTRIBUTED_ONLY);
    for (int k = 0; k < 3; ++k) any |= (colors[3 * g + k] > 0.0f) & (v_colors[3 * g + k] != 0.0f);
    if (any && count < 16) fetch_bands(rest + rest_offset, g, rest_stride, 3 * (terms - 1));
    received[count] = g;
    place[count] = OUTER ? i : g;
    count += any;
}
for (int i = 0; i < count; i += 16) {
    const int lanes = smaller(16, count - i);
    int row[16];
    take_rows(received + i, lanes, row);
    for (int l = 0; l < 16; ++l)
        fetch_bands(rest + rest_offset, received[smaller(i + 16 + l, count - 1)], rest_stride, 3 * (terms - 1));
    v16 color[3], v[3], x, y, z, norm, shrink;
    gather3(colors, row, n, color);
    gather3(v_colors, row, n, v);
    for (int k = 0; k < 3; ++k) v[k] = color[k] > 0.0f ? v[k] : (v16)0.0f;
    directions(means, row, n, camera, x, y, z, norm, shrink);
    const v16 xx = x * x, yy = y * y, zz = z * z;
    const v16 v_constant[3] = {CONSTANT * v[0], CONSTANT * v[1], CONSTANT * v[2]};
    if (base_stride == 3) scatter3(v_base, row, v_constant[0], v_constant[1], v_constant[2], lanes);
    else put_bands(v_base, row, base_stride, 3, v_constant, lanes);
    if (factors) {
        scatter4(factor_directions, place + i, x, y, z, (v16)0.0f, lanes);
        scatter4(factor_colors, place + i, v[0], v[1], v[2], (v16)0.0f, lanes);
    } else if (!OUTER) {
        v16 basis[16], v_sh[48];
        harmonics(x, y, z, degree, basis);
        for (int band = 1; band < terms; ++band)
            for (int k = 0; k < 3; ++k) v_sh[3 * band - 3 + k] = basis[band] * v[k];
        put_bands(v_rest + rest_offset, place + i, rest_stride, 3 * (terms - 1), v_sh, lanes);
    }
    if (degree == 0) continue;
    v16 sh[48], along[16];
    take_bands(rest + rest_offset, row, rest_stride, 3 * (terms - 1), sh);
    for (int band = 1; band < terms; ++band)
        along[band] = sh[3 * band - 3] * v[0] + sh[3 * band - 2] * v[1] + sh[3 * band - 1] * v[2];
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
    // Through the normalisation of the direction.
    const v16 back = norm * shrink, radial = vx * x + vy * y + vz * z;
    const v16 v_direction[3] = {(vx - radial * x) * back, (vy - radial * y) * back, (vz - radial * z) * back};
    scatter3(v_means, row, v_direction[0], v_direction[1], v_direction[2], lanes);
    alignas(64) float moved[3][16];
    for (int k = 0; k < 3; ++k) *(v16*)moved[k] = v_direction[k];
    for (int l = 0; l < lanes; ++l)
        for (int k = 0; k < 3; ++k) camera_sum[k] -= moved[k][l];
}
for (int k = 0; k < 3; ++k) v_cameras[3 * block + k] = camera_sum[k];
