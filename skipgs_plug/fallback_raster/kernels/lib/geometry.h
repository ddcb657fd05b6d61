// 16 Gaussians seen by a camera, in steps that the projection and its adjoint share.
//
// With M = R(quat) diag(scale), W the rotation of the camera and J the Jacobian of the projection, the 2D covariance
// is T T^t for the 2x3 matrix T = J W M. Working with T instead of the covariances makes the determinant a sum of
// squares, |T0 x T1|^2 (Cauchy-Binet), so that needles and giants lose no digits and no matrix turns indefinite.

#pragma once
#include "simd.h"

// Focal lengths and principal point of a camera, pixels.
struct Intrinsics {
    float fx, fy, cx, cy;
};
static constexpr auto intrinsics = [](const Camera& camera) INLINE -> Intrinsics {
    const float* K = camera.K;
    return {K[0], K[4], K[2], K[5]};
};

// Share of the image's width and height by which the point where the Jacobian is taken may lie outside the image: 30 % of
// half the field of view, as in gsplat. Without a bound the Jacobian, and with it the Gaussian's size in pixels, would
// grow with the distance from the image.
static constexpr float JACOBIAN_MARGIN = 0.15f;

// Most standard deviations from a centre to a pixel that the Gaussian contributes to: sqrt(2 ln 255), rounded up.
static constexpr float MAX_DEVIATIONS = 3.33f;

// Bounds of a sphere around a Gaussian, which are a little larger than those of the Gaussian: culling by the sphere must
// not cull what the exact test keeps. Standard deviations: MAX_DEVIATIONS and a hundredth more for rounding.
static constexpr float SPHERE_DEVIATIONS = 3.37f;
// Pixels that the sphere reaches farther: one by which a radius is rounded up, and half a pixel for rounding.
static constexpr float SPHERE_MARGIN = 1.5f;
// Further pixels for the rounding of a coordinate, as a share of it: about 80 times the distance to the next float.
static constexpr float SPHERE_RELATIVE_MARGIN = 1e-5f;

// Centres of 16 rows in world space and in camera space.
struct Centers {
    v16 world[3], x, y, z;
};
static constexpr auto centers = [](const Camera& camera, const float* means, const int* row, int n) INLINE -> Centers {
    const float* V = camera.viewmat;
    Centers c;
    gather3(means, row, n, c.world);
    c.x = V[0] * c.world[0] + V[1] * c.world[1] + V[2] * c.world[2] + V[3];
    c.y = V[4] * c.world[0] + V[5] * c.world[1] + V[6] * c.world[2] + V[7];
    c.z = V[8] * c.world[0] + V[9] * c.world[1] + V[10] * c.world[2] + V[11];
    return c;
};

// Unit quaternions, the two factors that made them so, and their matrices.
struct Rotations {
    v16 w, x, y, z, scale, norm, R[3][3];
};
static constexpr auto rotations = [](const float* quats, const int* row) INLINE -> Rotations {
    // Scaled first so that its square neither overflows nor vanishes; zero stands for no rotation.
    v16 q[4];
    gather4(quats, row, q);
    v16 w = q[0], x = q[1], y = q[2], z = q[3];
    const v16 most = vmax(vmax(vabs(w), vabs(x)), vmax(vabs(y), vabs(z)));
    const v16 scale = most > 1e-20f ? 1.0f / most : (v16)0.0f;
    w *= scale, x *= scale, y *= scale, z *= scale;
    const v16 norm = 1.0f / vsqrt(vmax(w * w + x * x + y * y + z * z, (v16)1e-20f));
    w *= norm, x *= norm, y *= norm, z *= norm;
    return {w, x, y, z, scale, norm,
            {{1.0f - 2.0f * (y * y + z * z), 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)},
             {2.0f * (x * y + w * z), 1.0f - 2.0f * (x * x + z * z), 2.0f * (y * z - w * x)},
             {2.0f * (x * z - w * y), 2.0f * (y * z + w * x), 1.0f - 2.0f * (x * x + y * y)}}};
};

// x / z and y / z where the Jacobian is taken.
struct Tangents {
    v16 x, y;
};
static constexpr auto jacobian_tangents = [](const Camera& camera, const Centers& center, v16 iz) INLINE -> Tangents {
    const auto [fx, fy, cx, cy] = intrinsics(camera);
    const float margin_x = JACOBIAN_MARGIN * camera.width / fx, margin_y = JACOBIAN_MARGIN * camera.height / fy;
    const v16 right = (v16)((camera.width - cx) / fx + margin_x), left = (v16)(-cx / fx - margin_x);
    const v16 bottom = (v16)((camera.height - cy) / fy + margin_y), top = (v16)(-cy / fy - margin_y);
    return {vmin(right, vmax(left, center.x * iz)), vmin(bottom, vmax(top, center.y * iz))};
};

// T = J W M, with all that it is made of.
struct SplatAxes {
    v16 ux, uy;  // `Tangents`
    v16 J00, J02, J11, J12, WM[3][3], T0[3], T1[3];
};
static constexpr auto splat_axes = [](const Camera& camera, const Centers& center, v16 iz, const v16 (&R)[3][3],
                                      const v16 (&S)[3]) INLINE -> SplatAxes {
    const float* V = camera.viewmat;
    const auto [fx, fy, cx, cy] = intrinsics(camera);
    SplatAxes a;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            a.WM[i][j] = (V[4 * i] * R[0][j] + V[4 * i + 1] * R[1][j] + V[4 * i + 2] * R[2][j]) * S[j];

    const Tangents tangents = jacobian_tangents(camera, center, iz);
    a.ux = tangents.x, a.uy = tangents.y;
    a.J00 = fx * iz, a.J02 = -fx * a.ux * iz, a.J11 = fy * iz, a.J12 = -fy * a.uy * iz;
    for (int j = 0; j < 3; ++j) {
        a.T0[j] = a.J00 * a.WM[0][j] + a.J02 * a.WM[2][j];
        a.T1[j] = a.J11 * a.WM[1][j] + a.J12 * a.WM[2][j];
    }
    return a;
};

// Whether the sphere of radius `longest` around a centre reaches no pixel: the rows of T are at most as long as those of J
// times `longest`, and a radius is MAX_DEVIATIONS standard deviations at most, rounded up.
static constexpr auto beyond = [](const Camera& camera, const Centers& center, v16 iz, v16 longest) INLINE -> i16 {
    const auto [fx, fy, cx, cy] = intrinsics(camera);
    const auto [ux, uy] = jacobian_tangents(camera, center, iz);
    const v16 u = fx * center.x * iz + cx, v = fy * center.y * iz + cy, size = longest * iz;
    // By how many pixels an axis lies outside of the image and of the margin, and the sphere's extent along the axis,
    // squared: no roots.
    const auto outside = [](v16 u, float pixels) INLINE -> v16 {
        return vmax(-u, u - pixels) - (SPHERE_MARGIN + SPHERE_RELATIVE_MARGIN * vabs(u));
    };
    const auto extent = [&](float focal, v16 tangent) INLINE -> v16 {
        return SPHERE_DEVIATIONS * SPHERE_DEVIATIONS
             * (focal * focal * size * size * (1.0f + tangent * tangent) + camera.eps2d);
    };
    const v16 over_x = outside(u, camera.width), over_y = outside(v, camera.height);
    const v16 spread_x = extent(fx, ux), spread_y = extent(fy, uy);
    return ((over_x > 0.0f) & (over_x * over_x > spread_x)) | ((over_y > 0.0f) & (over_y * over_y > spread_y));
};

// 2D covariance T T^t without (sharp) and with eps2d on its diagonal, and its inverse, the conic.
struct Covariances {
    v16 sharp_xx, sharp_yy, xx, yy;
    v16 sharp_det, det, slope;  // the determinants and the covariance of x and y, divided by xx
    v16 conic_a, conic_b, conic_c;
};
static constexpr auto covariances = [](const SplatAxes& axes, float eps2d) INLINE -> Covariances {
    const v16(&T0)[3] = axes.T0, (&T1)[3] = axes.T1;
    Covariances c;
    c.sharp_xx = T0[0] * T0[0] + T0[1] * T0[1] + T0[2] * T0[2];
    c.sharp_yy = T1[0] * T1[0] + T1[1] * T1[1] + T1[2] * T1[2];
    const v16 cov_xy = T0[0] * T1[0] + T0[1] * T1[1] + T0[2] * T1[2];
    c.xx = c.sharp_xx + eps2d, c.yy = c.sharp_yy + eps2d;
    // Determinants divided by xx: with squares of lengths up to 1e30 the plain ones would overflow.
    const v16 unit = 1.0f / vsqrt(c.xx);
    const v16 c0 = (T0[1] * unit) * T1[2] - (T0[2] * unit) * T1[1];
    const v16 c1 = (T0[2] * unit) * T1[0] - (T0[0] * unit) * T1[2];
    const v16 c2 = (T0[0] * unit) * T1[1] - (T0[1] * unit) * T1[0];
    c.sharp_det = c0 * c0 + c1 * c1 + c2 * c2;
    const v16 i_xx = unit * unit;  // divisions take as long as all the rest
    c.det = c.sharp_det + (eps2d * (c.sharp_xx + c.sharp_yy) + eps2d * eps2d) * i_xx;
    c.slope = cov_xy * i_xx;
    c.conic_c = 1.0f / c.det, c.conic_b = -c.slope * c.conic_c, c.conic_a = i_xx + c.slope * c.slope * c.conic_c;
    return c;
};

// What the projection of 16 rows and its adjoint both need.
struct Projection {
    Rotations rotation;
    SplatAxes axes;
    Covariances cov;
};
// `S` are the standard deviations along the axes of the Gaussians, iz = 1 / center.z.
static constexpr auto project_rows = [](const Camera& camera, const float* quats, const int* row, const Centers& center,
                                        v16 iz, const v16 (&S)[3]) INLINE -> Projection {
    Projection p;
    p.rotation = rotations(quats, row);
    p.axes = splat_axes(camera, center, iz, p.rotation.R, S);
    p.cov = covariances(p.axes, camera.eps2d);
    return p;
};
