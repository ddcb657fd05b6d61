"""3D Gaussians to the image plane (EWA splatting, Zwicker et al. 2001; formulas as in gsplat 1.5), 16 at a time.

With M = R(quat) diag(scale), W the rotation of the camera and J the Jacobian of the projection, the 2D covariance
is T T^t for the 2x3 matrix T = J W M. Working with T instead of the covariances makes the determinant a sum of
squares, |T0 x T1|^2 (Cauchy-Binet), so that needles and giants lose no digits and no matrix turns indefinite.
"""

from .launch import FloatArray, IntArray, worker

# Rows that one worker clears and fills at a time, and that one partial sum of the camera's gradients covers.
BLOCK = 512

# Loads Gaussians `row[0..15]` and computes everything the forward and the backward pass share.
_GEOMETRY = """
    const float *V = viewmat, fx = K[0], cx = K[2], fy = K[4], cy = K[5];
    v16 px = gather(means, row, 3, 0), py = gather(means, row, 3, 1), pz = gather(means, row, 3, 2);
    v16 x = V[0] * px + V[1] * py + V[2] * pz + V[3];
    v16 y = V[4] * px + V[5] * py + V[6] * pz + V[7];
    v16 z = V[8] * px + V[9] * py + V[10] * pz + V[11];

    // Unit quaternion, scaled first so that its square neither overflows nor vanishes; zero stands for no rotation.
    v16 qw = gather(quats, row, 4, 0), qx = gather(quats, row, 4, 1);
    v16 qy = gather(quats, row, 4, 2), qz = gather(quats, row, 4, 3);
    v16 q_max = vmax(vmax(vabs(qw), vabs(qx)), vmax(vabs(qy), vabs(qz)));
    v16 q_scale = q_max > 1e-20f ? 1.0f / q_max : (v16)0.0f;
    qw *= q_scale; qx *= q_scale; qy *= q_scale; qz *= q_scale;
    v16 q_norm = 1.0f / vsqrt(vmax(qw * qw + qx * qx + qy * qy + qz * qz, (v16)1e-20f));
    qw *= q_norm; qx *= q_norm; qy *= q_norm; qz *= q_norm;
    v16 R[3][3] = {
        {1.0f - 2.0f * (qy * qy + qz * qz), 2.0f * (qx * qy - qw * qz), 2.0f * (qx * qz + qw * qy)},
        {2.0f * (qx * qy + qw * qz), 1.0f - 2.0f * (qx * qx + qz * qz), 2.0f * (qy * qz - qw * qx)},
        {2.0f * (qx * qz - qw * qy), 2.0f * (qy * qz + qw * qx), 1.0f - 2.0f * (qx * qx + qy * qy)}};
    v16 S[3] = {gather(scales, row, 3, 0), gather(scales, row, 3, 1), gather(scales, row, 3, 2)};
    v16 WM[3][3];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            WM[i][j] = (V[4 * i] * R[0][j] + V[4 * i + 1] * R[1][j] + V[4 * i + 2] * R[2][j]) * S[j];

    // The Jacobian is taken no further than 30 % of the half field of view outside the image.
    v16 iz = 1.0f / z;
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    const v16 right = (v16)((width - cx) / fx + margin_x), left = (v16)(-cx / fx - margin_x);
    const v16 bottom = (v16)((height - cy) / fy + margin_y), top = (v16)(-cy / fy - margin_y);
    v16 ux = vmin(right, vmax(left, x * iz)), uy = vmin(bottom, vmax(top, y * iz));
    v16 J00 = fx * iz, J02 = -fx * ux * iz, J11 = fy * iz, J12 = -fy * uy * iz;
    v16 T0[3], T1[3];
    for (int j = 0; j < 3; ++j) {
        T0[j] = J00 * WM[0][j] + J02 * WM[2][j];
        T1[j] = J11 * WM[1][j] + J12 * WM[2][j];
    }

    v16 sharp_xx = T0[0] * T0[0] + T0[1] * T0[1] + T0[2] * T0[2];
    v16 sharp_yy = T1[0] * T1[0] + T1[1] * T1[1] + T1[2] * T1[2];
    v16 cov_xy = T0[0] * T1[0] + T0[1] * T1[1] + T0[2] * T1[2];
    v16 cov_xx = sharp_xx + eps2d, cov_yy = sharp_yy + eps2d;
    // Determinants divided by cov_xx: with squares of lengths up to 1e30 the plain ones would overflow.
    v16 unit = 1.0f / vsqrt(cov_xx);
    v16 c0 = (T0[1] * unit) * T1[2] - (T0[2] * unit) * T1[1];
    v16 c1 = (T0[2] * unit) * T1[0] - (T0[0] * unit) * T1[2];
    v16 c2 = (T0[0] * unit) * T1[1] - (T0[1] * unit) * T1[0];
    v16 sharp_det = c0 * c0 + c1 * c1 + c2 * c2;
    v16 det = sharp_det + eps2d * (sharp_xx + sharp_yy) / cov_xx + eps2d * eps2d / cov_xx;
    v16 slope = cov_xy / cov_xx;
    v16 conic_c = 1.0f / det, conic_b = -slope / det, conic_a = 1.0f / cov_xx + slope * slope / det;
    v16 ratio = sharp_det / det;
"""


@worker(
    """
for (int base = first; base < last; base += 16) {
    const int lanes = last - base < 16 ? last - base : 16;
    int row[16];
    for (int l = 0; l < 16; ++l) row[l] = base + (l < lanes ? l : lanes - 1);
"""
    + _GEOMETRY
    + """
    v16 compensation = vsqrt(ratio);
    v16 opacity = gather(opacities, row, 1, 0) * (antialiased ? compensation : (v16)1.0f);
    // Written so that a NaN anywhere fails the test and the Gaussian is left out.
    i16 visible = (z >= near_plane) & (z <= far_plane) & (det > 0.0f) & (opacity >= 1.0f / 255.0f);
    v16 reach = vmin((v16)3.33f, vsqrt(1.38629436f * log2(255.0f * vmax(opacity, (v16)1e-3f))));
    v16 u = fx * x * iz + cx, v = fy * y * iz + cy;
    v16 sigma_x = vsqrt(cov_xx), sigma_y = vsqrt(cov_yy);
    v16 radius_x = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_x));
    v16 radius_y = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_y));
    // Thinner than a millionth of a pixel (only without eps2d): it meets no pixel centre, but overflows gradients.
    visible &= (conic_a < 1e12f) & (conic_c < 1e12f);
    visible &= (radius_x > radius_clip) | (radius_y > radius_clip);
    visible &= (u + radius_x > 0.0f) & (u - radius_x < width) & (v + radius_y > 0.0f) & (v - radius_y < height);

    const v16 none = (v16)0.0f;
    i16 rx = __builtin_convertvector(visible ? radius_x : none, i16);
    i16 ry = __builtin_convertvector(visible ? radius_y : none, i16);
    for (int l = 0; l < lanes; ++l) {
        radii[2 * row[l]] = rx[l];
        radii[2 * row[l] + 1] = ry[l];
    }
    scatter(means2d, row, 2, 0, visible ? u : none, lanes);
    scatter(means2d, row, 2, 1, visible ? v : none, lanes);
    scatter(depths, row, 1, 0, visible ? z : none, lanes);
    scatter(conics, row, 3, 0, visible ? conic_a : none, lanes);
    scatter(conics, row, 3, 1, visible ? conic_b : none, lanes);
    scatter(conics, row, 3, 2, visible ? conic_c : none, lanes);
    scatter(sigmas, row, 2, 0, visible ? sigma_x : none, lanes);
    scatter(sigmas, row, 2, 1, visible ? sigma_y : none, lanes);
    if (antialiased) scatter(compensations, row, 1, 0, visible ? compensation : none, lanes);
}
""",
    items="n",
    grain=512,
)
def project_forward(
    means: FloatArray,  # [N, 3]
    quats: FloatArray,  # [N, 4]
    scales: FloatArray,  # [N, 3]
    opacities: FloatArray,  # [N]
    viewmat: FloatArray,  # [4, 4]
    K: FloatArray,  # [3, 3]
    means2d: FloatArray,  # out [N, 2]
    depths: FloatArray,  # out [N]
    conics: FloatArray,  # out [N, 3], upper triangle of the inverse 2D covariance
    sigmas: FloatArray,  # out [N, 2], standard deviations along x and y in pixels
    compensations: FloatArray,  # out [N], only written when antialiased
    radii: IntArray,  # out [N, 2], zero where the Gaussian is not visible
    n: int,
    width: float,
    height: float,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    radius_clip: float,
    antialiased: int,
) -> None: ...


@worker(
    """
int m = 0;
for (int i = 0; i < n; ++i) {
    if (i % 512 == 0) block_start[i / 512] = m;
    visible[m] = i;
    m += radii[2 * i] > 0;
}
block_start[(n + 511) / 512] = m;
""",
    items="1",
    grain=1,
)
def list_visible(
    radii: IntArray,  # [N, 2]
    visible: IntArray,  # out [N], the rows with a radius come first
    block_start: IntArray,  # out [ceil(N / BLOCK) + 1], where each block of rows begins in `visible`
    n: int,
) -> None: ...


@worker(
    """
const int block = first;
v16 pose[12] = {};
// Cleared here and not all at once, so that the memory is still in the cache when the gradients follow.
const int row_begin = 512 * block, rows = n - row_begin < 512 ? n - row_begin : 512;
clear(v_means + 3ll * row_begin, 3 * rows);
clear(v_quats + 4ll * row_begin, 4 * rows);
clear(v_scales + 3ll * row_begin, 3 * rows);
const int end = block_start[block + 1];
for (int base = block_start[block]; base < end; base += 16) {
    const int lanes = end - base < 16 ? end - base : 16;
    int row[16];
    for (int l = 0; l < 16; ++l) row[l] = visible[base + (l < lanes ? l : lanes - 1)];
    v16 v_u = gather(v_means2d, row, 2, 0), v_v = gather(v_means2d, row, 2, 1), v_depth = (v16)0.0f, v_comp = (v16)0.0f;
    if (with_depth) v_depth = gather(v_depths, row, 1, 0);
    if (antialiased) v_comp = gather(v_compensations, row, 1, 0);
    v16 va = gather(v_conics, row, 3, 0), vb = 0.5f * gather(v_conics, row, 3, 1), vc = gather(v_conics, row, 3, 2);
    // Most blocks of a close-up hold no Gaussian that received a gradient; their zeros are in place already.
    if ((shortcuts & 32) && !any((v_u != 0.0f) | (v_v != 0.0f) | (v_depth != 0.0f) | (va != 0.0f) | (vb != 0.0f)
                                 | (vc != 0.0f) | (v_comp != 0.0f))) continue;
"""
    + _GEOMETRY
    + """
    // Extreme cameras (a principal point 1e5 images away) leave float's range: a huge gradient is better than
    // infinity, and infinity less infinity is NaN. No gradient of a usual scene comes near these bounds.
    auto saturated = [](v16 v, float most) -> v16 { return v > most ? (v16)most : (v < -most ? (v16)-most : v); };
    v_u = saturated(v_u, 1e20f); v_v = saturated(v_v, 1e20f);
    va = saturated(va, 1e12f); vb = saturated(vb, 1e12f); vc = saturated(vc, 1e12f);

    // Inverse of a matrix: v_cov = -conic v_conic conic, all symmetric.
    v16 pa = conic_a * va + conic_b * vb, pb = conic_a * vb + conic_b * vc;
    v16 pc = conic_b * va + conic_c * vb, pd = conic_b * vb + conic_c * vc;
    v16 v_xx = -(pa * conic_a + pb * conic_b), v_xy = -(pa * conic_b + pb * conic_c);
    v16 v_yy = -(pc * conic_b + pd * conic_c);
    if (antialiased) {
        // compensation = sqrt(sharp det / det); both determinants here are divided by cov_xx.
        v16 half_comp = sharp_det > 1e-30f ? 0.5f * v_comp * vsqrt(ratio) : (v16)0.0f;
        v16 i_sharp = 1.0f / vmax(sharp_det, (v16)1e-30f), i_blurred = 1.0f / det;
        v_xx += half_comp * (sharp_yy / cov_xx * i_sharp - cov_yy / cov_xx * i_blurred);
        v_yy += half_comp * (sharp_xx / cov_xx * i_sharp - i_blurred);
        v_xy += half_comp * slope * (i_blurred - i_sharp);
    }

    v_xx = saturated(v_xx, 1e15f); v_xy = saturated(v_xy, 1e15f); v_yy = saturated(v_yy, 1e15f);
    v16 v_WM[3][3], v_J00 = (v16)0.0f, v_J02 = v_J00, v_J11 = v_J00, v_J12 = v_J00;
    for (int j = 0; j < 3; ++j) {
        v16 v_T0 = saturated(2.0f * (v_xx * T0[j] + v_xy * T1[j]), 1e20f);
        v16 v_T1 = saturated(2.0f * (v_xy * T0[j] + v_yy * T1[j]), 1e20f);
        v_J00 += v_T0 * WM[0][j];
        v_J02 += v_T0 * WM[2][j];
        v_J11 += v_T1 * WM[1][j];
        v_J12 += v_T1 * WM[2][j];
        v_WM[0][j] = J00 * v_T0;
        v_WM[1][j] = J11 * v_T1;
        v_WM[2][j] = J02 * v_T0 + J12 * v_T1;
    }

    v_J00 = saturated(v_J00, 1e20f); v_J02 = saturated(v_J02, 1e20f);
    v_J11 = saturated(v_J11, 1e20f); v_J12 = saturated(v_J12, 1e20f);
    // Projection: u = fx x / z + cx; J00 = fx / z; J02 = -fx ux / z with ux = x / z where it is not clamped.
    v16 inside_x = ux == x * iz ? (v16)1.0f : (v16)0.0f, inside_y = uy == y * iz ? (v16)1.0f : (v16)0.0f;
    v16 v_tx = v_u - inside_x * v_J02 * iz, v_ty = v_v - inside_y * v_J12 * iz;
    v16 v_x = saturated(fx * iz * v_tx, 1e20f), v_y = saturated(fy * iz * v_ty, 1e20f);
    v16 v_z = v_depth - iz * (x * v_x + y * v_y) - iz * (J00 * v_J00 + J02 * v_J02 + J11 * v_J11 + J12 * v_J12);

    v_z = saturated(v_z, 1e20f);
    v16 v_mean[3], v_M[3][3];
    for (int i = 0; i < 3; ++i) {
        v_mean[i] = V[i] * v_x + V[4 + i] * v_y + V[8 + i] * v_z;
        for (int j = 0; j < 3; ++j)
            v_M[i][j] = saturated(V[i] * v_WM[0][j] + V[4 + i] * v_WM[1][j] + V[8 + i] * v_WM[2][j], 1e30f);
    }
    if (with_pose) {
        const i16 in_use = lane < (float)lanes;
        const v16 v_camera[3] = {v_x, v_y, v_z};
        for (int i = 0; i < 3; ++i) {
            v16 v = in_use ? v_camera[i] : (v16)0.0f;
            pose[4 * i] += v * px;
            pose[4 * i + 1] += v * py;
            pose[4 * i + 2] += v * pz;
            pose[4 * i + 3] += v;
            for (int k = 0; k < 3; ++k)
                for (int j = 0; j < 3; ++j)
                    pose[4 * i + k] += in_use ? v_WM[i][j] * R[k][j] * S[j] : (v16)0.0f;
        }
    }

    for (int i = 0; i < 3; ++i) scatter(v_means, row, 3, i, v_mean[i], lanes);
    for (int j = 0; j < 3; ++j)
        scatter(v_scales, row, 3, j, v_M[0][j] * R[0][j] + v_M[1][j] * R[1][j] + v_M[2][j] * R[2][j], lanes);
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) v_M[i][j] *= 2.0f * S[j];
    v16 v_qw = qx * (v_M[2][1] - v_M[1][2]) + qy * (v_M[0][2] - v_M[2][0]) + qz * (v_M[1][0] - v_M[0][1]);
    v16 v_qx = qw * (v_M[2][1] - v_M[1][2]) + qy * (v_M[0][1] + v_M[1][0]) + qz * (v_M[0][2] + v_M[2][0])
             - 2.0f * qx * (v_M[1][1] + v_M[2][2]);
    v16 v_qy = qw * (v_M[0][2] - v_M[2][0]) + qx * (v_M[0][1] + v_M[1][0]) + qz * (v_M[1][2] + v_M[2][1])
             - 2.0f * qy * (v_M[0][0] + v_M[2][2]);
    v16 v_qz = qw * (v_M[1][0] - v_M[0][1]) + qx * (v_M[0][2] + v_M[2][0]) + qy * (v_M[1][2] + v_M[2][1])
             - 2.0f * qz * (v_M[0][0] + v_M[1][1]);
    v16 along = qw * v_qw + qx * v_qx + qy * v_qy + qz * v_qz;
    v16 back = q_norm * q_scale;
    scatter(v_quats, row, 4, 0, saturated((v_qw - along * qw) * back, 1e38f), lanes);
    scatter(v_quats, row, 4, 1, saturated((v_qx - along * qx) * back, 1e38f), lanes);
    scatter(v_quats, row, 4, 2, saturated((v_qy - along * qy) * back, 1e38f), lanes);
    scatter(v_quats, row, 4, 3, saturated((v_qz - along * qz) * back, 1e38f), lanes);
}
if (with_pose)
    for (int i = 0; i < 12; ++i) v_poses[12 * block + i] = sum(pose[i]);
""",
    items="(n + 511) / 512",
    grain=1,
)
def project_backward(
    means: FloatArray,  # [N, 3]
    quats: FloatArray,  # [N, 4]
    scales: FloatArray,  # [N, 3]
    viewmat: FloatArray,  # [4, 4]
    K: FloatArray,  # [3, 3]
    visible: IntArray,  # [M], rows with a radius
    block_start: IntArray,  # [ceil(N / BLOCK) + 1], where each block of rows begins in `visible`
    v_means2d: FloatArray,  # [N, 2]
    v_depths: FloatArray,  # [N], only read with_depth
    v_conics: FloatArray,  # [N, 3]
    v_compensations: FloatArray,  # [N], only read when antialiased
    v_means: FloatArray,  # out [N, 3]
    v_quats: FloatArray,  # out [N, 4]
    v_scales: FloatArray,  # out [N, 3]
    v_poses: FloatArray,  # out [ceil(N / BLOCK), 3, 4], partial sums, only written with_pose
    n: int,
    width: float,
    height: float,
    eps2d: float,
    with_depth: int,
    antialiased: int,
    with_pose: int,
    shortcuts: int,
) -> None: ...
