"""Spherical harmonics up to degree 3 to view-dependent colour: max(0, 0.5 + sum_k basis_k(direction) * sh_k).

Real basis with the signs of 3DGS (Kerbl et al. 2023). Only Gaussians with a radius are evaluated.
"""

from .launch import FloatArray, IntArray, worker

# basis[k], and with derivatives: slope[k][axis], for the unit vector (x, y, z). `degree` is 0 to 3.
_BASIS = """
    float dx = means[3 * g] - camera[0], dy = means[3 * g + 1] - camera[1], dz = means[3 * g + 2] - camera[2];
    // Scaled by the longest side first: the square of a tiny or huge distance would leave float's range.
    float longest = fmaxf(fabsf(dx), fmaxf(fabsf(dy), fabsf(dz)));
    float shrink = longest > 1e-30f ? 1.0f / longest : 0.0f;
    float x = dx * shrink, y = dy * shrink, z = dz * shrink;
    float norm = 1.0f / sqrtf(fmaxf(x * x + y * y + z * z, 1e-30f));
    x *= norm; y *= norm; z *= norm;
    float xx = x * x, yy = y * y, zz = z * z;
    float basis[16];
    basis[0] = 0.28209479177387814f;
    if (degree > 0) {
        basis[1] = -0.4886025119029199f * y;
        basis[2] = 0.4886025119029199f * z;
        basis[3] = -0.4886025119029199f * x;
    }
    if (degree > 1) {
        basis[4] = 1.0925484305920792f * x * y;
        basis[5] = -1.0925484305920792f * y * z;
        basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
        basis[7] = -1.0925484305920792f * x * z;
        basis[8] = 0.5462742152960396f * (xx - yy);
    }
    if (degree > 2) {
        basis[9] = -0.5900435899266435f * y * (3.0f * xx - yy);
        basis[10] = 2.890611442640554f * x * y * z;
        basis[11] = -0.4570457994644658f * y * (4.0f * zz - xx - yy);
        basis[12] = 0.3731763325901154f * z * (2.0f * zz - 3.0f * xx - 3.0f * yy);
        basis[13] = -0.4570457994644658f * x * (4.0f * zz - xx - yy);
        basis[14] = 1.445305721320277f * z * (xx - yy);
        basis[15] = -0.5900435899266435f * x * (xx - 3.0f * yy);
    }
    const int terms = (degree + 1) * (degree + 1);
    const float* constant = base + (long long)g * base_stride;
    const float* sh = rest + (long long)g * rest_stride + rest_offset - 3;  // sh[3 k] is band k, from 1 on
"""


@worker(
    """
const int block = first;
clear(colors + 1536ll * block, 3 * smaller(512, n - 512 * block));
for (int i = block_start[block]; i < block_start[block + 1]; ++i) {
    const int g = visible[i];
"""
    + _BASIS
    + """
    float c0 = 0.5f + basis[0] * constant[0], c1 = 0.5f + basis[0] * constant[1], c2 = 0.5f + basis[0] * constant[2];
    for (int k = 1; k < terms; ++k) {
        c0 += basis[k] * sh[3 * k];
        c1 += basis[k] * sh[3 * k + 1];
        c2 += basis[k] * sh[3 * k + 2];
    }
    // Written so that NaN stays NaN: a bad coefficient must be seen in the pixels it touches.
    colors[3 * g] = c0 < 0.0f ? 0.0f : c0;
    colors[3 * g + 1] = c1 < 0.0f ? 0.0f : c1;
    colors[3 * g + 2] = c2 < 0.0f ? 0.0f : c2;
}
""",
    items="(n + 511) / 512",
    grain=1,
)
def sh_forward(
    means: FloatArray,  # [N, 3]
    camera: FloatArray,  # [3], centre of the camera in world space
    base: FloatArray,  # constant band of Gaussian g at base_stride * g
    rest: FloatArray,  # the others at rest_stride * g + rest_offset; may be the same array
    visible: IntArray,  # [M]
    block_start: IntArray,  # [ceil(N / BLOCK) + 1], where each block of rows begins in `visible`
    colors: FloatArray,  # out [N, 3], zero where not visible
    n: int,
    base_stride: int,
    rest_stride: int,
    rest_offset: int,
    degree: int,
) -> None: ...


@worker(
    """
const int block = first;
float camera_sum[3] = {0.0f, 0.0f, 0.0f};
// Cleared here and not all at once, so that the memory is still in the cache when the gradients follow.
const long long row_begin = 512ll * block, rows = n - row_begin < 512 ? n - row_begin : 512;
clear(v_means + 3 * row_begin, 3 * rows);
clear(v_base + base_stride * row_begin, base_stride * rows);
if (v_rest != v_base) clear(v_rest + rest_stride * row_begin, rest_stride * rows);
for (int i = block_start[block]; i < block_start[block + 1]; ++i) {
    const int g = visible[i];
    // Where the colour was clamped at zero, and where nothing blended the Gaussian, there is no gradient.
    float v0 = colors[3 * g] > 0.0f ? v_colors[3 * g] : 0.0f;
    float v1 = colors[3 * g + 1] > 0.0f ? v_colors[3 * g + 1] : 0.0f;
    float v2 = colors[3 * g + 2] > 0.0f ? v_colors[3 * g + 2] : 0.0f;
    if (v0 == 0.0f && v1 == 0.0f && v2 == 0.0f && (shortcuts & 32)) continue;
"""
    + _BASIS
    + """
    float* v_constant = v_base + (long long)g * base_stride;
    float* v_sh = v_rest + (long long)g * rest_stride + rest_offset - 3;
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
""",
    items="(n + 511) / 512",
    grain=1,
)
def sh_backward(
    means: FloatArray,  # [N, 3]
    camera: FloatArray,  # [3]
    base: FloatArray,  # constant band of Gaussian g at base_stride * g
    rest: FloatArray,  # the others at rest_stride * g + rest_offset; may be the same array
    visible: IntArray,  # [M]
    block_start: IntArray,  # [ceil(N / BLOCK) + 1], where each block of rows begins in `visible`
    colors: FloatArray,  # [N, 3], result of the forward pass
    v_colors: FloatArray,  # [N, 3]
    v_means: FloatArray,  # out [N, 3]
    v_base: FloatArray,  # out, like base
    v_rest: FloatArray,  # out, like rest; may be the same array
    v_cameras: FloatArray,  # out [ceil(N / BLOCK), 3], partial sums
    n: int,
    base_stride: int,
    rest_stride: int,
    rest_offset: int,
    degree: int,
    shortcuts: int,
) -> None: ...
