// 16 Gaussians seen by a camera, in four steps that the forward and the backward pass of the projection share.
//
// With M = R(quat) diag(scale), W the rotation of the camera and J the Jacobian of the projection, the 2D covariance
// is T T^t for the 2x3 matrix T = J W M. Working with T instead of the covariances makes the determinant a sum of
// squares, |T0 x T1|^2 (Cauchy-Binet), so that needles and giants lose no digits and no matrix turns indefinite.

// Centres of the rows in world space, p, and in camera space.
static constexpr auto centres = [](const float* V, const float* means, const int* row, int n, v16 (&p)[3], v16& x,
                                   v16& y, v16& z) INLINE {
    gather3(means, row, n, p);
    x = V[0] * p[0] + V[1] * p[1] + V[2] * p[2] + V[3];
    y = V[4] * p[0] + V[5] * p[1] + V[6] * p[2] + V[7];
    z = V[8] * p[0] + V[9] * p[1] + V[10] * p[2] + V[11];
};

// Unit quaternions, the two factors that made them so, and their matrices.
static constexpr auto rotations = [](const float* quats, const int* row, v16& qw, v16& qx, v16& qy, v16& qz,
                                     v16& q_scale, v16& q_norm, v16 (&R)[3][3]) INLINE {
    // Scaled first so that its square neither overflows nor vanishes; zero stands for no rotation.
    v16 q[4];
    gather4(quats, row, q);
    qw = q[0], qx = q[1], qy = q[2], qz = q[3];
    const v16 q_max = vmax(vmax(vabs(qw), vabs(qx)), vmax(vabs(qy), vabs(qz)));
    q_scale = q_max > 1e-20f ? 1.0f / q_max : (v16)0.0f;
    qw *= q_scale, qx *= q_scale, qy *= q_scale, qz *= q_scale;
    q_norm = 1.0f / vsqrt(vmax(qw * qw + qx * qx + qy * qy + qz * qz, (v16)1e-20f));
    qw *= q_norm, qx *= q_norm, qy *= q_norm, qz *= q_norm;
    R[0][0] = 1.0f - 2.0f * (qy * qy + qz * qz);
    R[0][1] = 2.0f * (qx * qy - qw * qz);
    R[0][2] = 2.0f * (qx * qz + qw * qy);
    R[1][0] = 2.0f * (qx * qy + qw * qz);
    R[1][1] = 1.0f - 2.0f * (qx * qx + qz * qz);
    R[1][2] = 2.0f * (qy * qz - qw * qx);
    R[2][0] = 2.0f * (qx * qz - qw * qy);
    R[2][1] = 2.0f * (qy * qz + qw * qx);
    R[2][2] = 1.0f - 2.0f * (qx * qx + qy * qy);
};

// T = J W M, with all that it is made of.
static constexpr auto splat_axes = [](const float* V, const float* K, float width, float height, v16 x, v16 y, v16 iz,
                                      const v16 (&R)[3][3], const v16 (&S)[3], v16& ux, v16& uy, v16& J00,
                                      v16& J02, v16& J11, v16& J12, v16 (&WM)[3][3], v16 (&T0)[3],
                                      v16 (&T1)[3]) INLINE {
    const float fx = K[0], cx = K[2], fy = K[4], cy = K[5];
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            WM[i][j] = (V[4 * i] * R[0][j] + V[4 * i + 1] * R[1][j] + V[4 * i + 2] * R[2][j]) * S[j];

    // The Jacobian is taken no further than 30 % of the half field of view outside the image.
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    const v16 right = (v16)((width - cx) / fx + margin_x), left = (v16)(-cx / fx - margin_x);
    const v16 bottom = (v16)((height - cy) / fy + margin_y), top = (v16)(-cy / fy - margin_y);
    ux = vmin(right, vmax(left, x * iz)), uy = vmin(bottom, vmax(top, y * iz));
    J00 = fx * iz, J02 = -fx * ux * iz, J11 = fy * iz, J12 = -fy * uy * iz;
    for (int j = 0; j < 3; ++j) {
        T0[j] = J00 * WM[0][j] + J02 * WM[2][j];
        T1[j] = J11 * WM[1][j] + J12 * WM[2][j];
    }
};

// Whether the sphere of radius `longest` around a centre reaches no pixel: the rows of T are at most as long as those of J
// times `longest`, and a radius is 3.33 standard deviations at most, rounded up. A hundredth more pays for rounding.
static constexpr auto beyond = [](const float* K, float width, float height, float eps2d, v16 x, v16 y, v16 iz,
                                  v16 longest) INLINE -> i16 {
    const float fx = K[0], cx = K[2], fy = K[4], cy = K[5];
    const float margin_x = 0.15f * width / fx, margin_y = 0.15f * height / fy;
    const v16 ux = vmin((v16)((width - cx) / fx + margin_x), vmax((v16)(-cx / fx - margin_x), x * iz));
    const v16 uy = vmin((v16)((height - cy) / fy + margin_y), vmax((v16)(-cy / fy - margin_y), y * iz));
    const v16 u = fx * x * iz + cx, v = fy * y * iz + cy, size = longest * iz;
    // By how much they are outside, squared: no roots.
    const v16 over_x = vmax(-u, u - width) - (1.5f + 1e-5f * vabs(u)), over_y = vmax(-v, v - height) - (1.5f + 1e-5f * vabs(v));
    const v16 spread_x = 3.37f * 3.37f * (fx * fx * size * size * (1.0f + ux * ux) + eps2d);
    const v16 spread_y = 3.37f * 3.37f * (fy * fy * size * size * (1.0f + uy * uy) + eps2d);
    return ((over_x > 0.0f) & (over_x * over_x > spread_x)) | ((over_y > 0.0f) & (over_y * over_y > spread_y));
};

// 2D covariance T T^t without (sharp) and with eps2d on its diagonal, and its inverse.
static constexpr auto covariances = [](const v16 (&T0)[3], const v16 (&T1)[3], float eps2d, v16& sharp_xx,
                                       v16& sharp_yy, v16& cov_xx, v16& cov_yy, v16& sharp_det, v16& det, v16& slope,
                                       v16& conic_a, v16& conic_b, v16& conic_c) INLINE {
    sharp_xx = T0[0] * T0[0] + T0[1] * T0[1] + T0[2] * T0[2];
    sharp_yy = T1[0] * T1[0] + T1[1] * T1[1] + T1[2] * T1[2];
    const v16 cov_xy = T0[0] * T1[0] + T0[1] * T1[1] + T0[2] * T1[2];
    cov_xx = sharp_xx + eps2d, cov_yy = sharp_yy + eps2d;
    // Determinants divided by cov_xx: with squares of lengths up to 1e30 the plain ones would overflow.
    const v16 unit = 1.0f / vsqrt(cov_xx);
    const v16 c0 = (T0[1] * unit) * T1[2] - (T0[2] * unit) * T1[1];
    const v16 c1 = (T0[2] * unit) * T1[0] - (T0[0] * unit) * T1[2];
    const v16 c2 = (T0[0] * unit) * T1[1] - (T0[1] * unit) * T1[0];
    sharp_det = c0 * c0 + c1 * c1 + c2 * c2;
    const v16 i_xx = unit * unit;  // divisions take as long as all the rest
    det = sharp_det + (eps2d * (sharp_xx + sharp_yy) + eps2d * eps2d) * i_xx;
    slope = cov_xy * i_xx;
    conic_c = 1.0f / det, conic_b = -slope * conic_c, conic_a = i_xx + slope * slope * conic_c;
};
