// Adjoint of sh_forward for one block of rows.
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
if (packed) clear(v_rest + (long long)rest_stride * block_start[block], rest_stride * listed);
else if (v_rest != v_base) clear_rows(v_rest + rest_stride * row_begin, rest_stride * rows);
for (int i = block_start[block]; i < block_start[block + 1]; ++i) {
    const int g = visible[i];
    // Where the colour was clamped at zero, and where nothing blended the Gaussian, there is no gradient.
    float v0 = colors[3 * g] > 0.0f ? v_colors[3 * g] : 0.0f;
    float v1 = colors[3 * g + 1] > 0.0f ? v_colors[3 * g + 1] : 0.0f;
    float v2 = colors[3 * g + 2] > 0.0f ? v_colors[3 * g + 2] : 0.0f;
    if (v0 == 0.0f && v1 == 0.0f && v2 == 0.0f && (shortcuts & CONTRIBUTED_ONLY)) continue;
    float basis[16], x, y, z, norm, shrink;
    harmonics(means + 3ll * g, camera, degree, basis, x, y, z, norm, shrink);
    const float xx = x * x, yy = y * y, zz = z * z;
    const int terms = (degree + 1) * (degree + 1);
    const float* sh = rest + (long long)g * rest_stride + rest_offset - 3;  // sh[3 k] is band k, from 1 on
    float* v_constant = v_base + (long long)g * base_stride;
    float* v_sh = v_rest + (long long)(packed ? i : g) * rest_stride + rest_offset - 3;
    v_constant[0] = basis[0] * v0;
    v_constant[1] = basis[0] * v1;
    v_constant[2] = basis[0] * v2;
    float along[16];
    for (int k = 1; k < terms; ++k) {
        v_sh[3 * k] = basis[k] * v0;
        v_sh[3 * k + 1] = basis[k] * v1;
        v_sh[3 * k + 2] = basis[k] * v2;
        along[k] = sh[3 * k] * v0 + sh[3 * k + 1] * v1 + sh[3 * k + 2] * v2;
    }
    if (degree == 0) continue;
    float vx = -0.4886025119029199f * along[3], vy = -0.4886025119029199f * along[1];
    float vz = 0.4886025119029199f * along[2];
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
    const float back = norm * shrink, radial = vx * x + vy * y + vz * z;
    const float v_direction[3] = {(vx - radial * x) * back, (vy - radial * y) * back, (vz - radial * z) * back};
    for (int c = 0; c < 3; ++c) {
        v_means[3 * g + c] = v_direction[c];
        camera_sum[c] -= v_direction[c];
    }
}
for (int c = 0; c < 3; ++c) v_cameras[3 * block + c] = camera_sum[c];
