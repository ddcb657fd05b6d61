// Centre, depth, inverse covariance and extent on the image plane of one block of rows, and which of them are visible.
#include "lib/geometry.h"
const int block = first, row_begin = BLOCK * block, row_end = smaller(row_begin + BLOCK, n);
int found = row_begin;
for (int base = row_begin; base < row_end; base += 16) {
    const int lanes = smaller(16, row_end - base);
    int row[16];
    for (int l = 0; l < 16; ++l) row[l] = base + (l < lanes ? l : lanes - 1);
    v16 world[3], x, y, z, qw, qx, qy, qz, q_scale, q_norm, R[3][3];
    v16 iz, ux, uy, J00, J02, J11, J12, WM[3][3], T0[3], T1[3];
    v16 sharp_xx, sharp_yy, cov_xx, cov_yy, sharp_det, det, slope, conic_a, conic_b, conic_c;
    v16 S[3];
    gather3(scales, row, n, S);
    centres(viewmat, means, row, n, world, x, y, z);
    iz = 1.0f / z;
    // What lies outside even as a sphere of its longest axis needs no rotation. Neighbours in space that are neighbours
    // in memory are left out 16 at a time. Written so that NaN goes on to the full test.
    v16 longest = vmax(vmax(vabs(S[0]), vabs(S[1])), vabs(S[2]));
    if (raw) longest = vexp(vmax(vmax(S[0], S[1]), S[2]));
    i16 outside = (z < near_plane) | (z > far_plane);
    if (optimizations & SPHERES) outside |= beyond(K, width, height, eps2d, x, y, iz, longest);
    if (!any(~outside)) {
        if (dense) {
            if (with_radii) clear((float*)radii + 2ll * base, 2 * lanes);
            clear(means2d + 2ll * base, 2 * lanes);
            clear(depths + base, lanes);
            clear(conics + 3ll * base, 3 * lanes);
            clear(sigmas + 2ll * base, 2 * lanes);
            if (antialiased) clear(compensations + base, lanes);
        }
        continue;
    }
    if (raw)
        for (int j = 0; j < 3; ++j) S[j] = vexp(S[j]);
    rotations(quats, row, qw, qx, qy, qz, q_scale, q_norm, R);
    splat_axes(viewmat, K, width, height, x, y, iz, R, S, ux, uy, J00, J02, J11, J12, WM, T0, T1);
    covariances(T0, T1, eps2d, sharp_xx, sharp_yy, cov_xx, cov_yy, sharp_det, det, slope, conic_a, conic_b, conic_c);

    v16 compensation = (v16)1.0f;
    if (antialiased) compensation = vsqrt(sharp_det / det);
    v16 opacity = gather(opacities, row, 1, 0);
    if (raw) opacity = sigmoid(opacity);
    if (antialiased) opacity *= compensation;
    // Written so that a NaN anywhere fails the test and the Gaussian is left out.
    i16 visible = (z >= near_plane) & (z <= far_plane) & (det > 0.0f) & (opacity >= ALPHA_MIN);
    v16 reach = vmin((v16)3.33f, vsqrt(LN_4 * log2(255.0f * vmax(opacity, (v16)1e-3f))));
    v16 u = K[0] * x * iz + K[2], v = K[4] * y * iz + K[5];
    v16 sigma_x = vsqrt(cov_xx), sigma_y = vsqrt(cov_yy);
    v16 radius_x = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_x));
    v16 radius_y = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_y));
    // Thinner than a millionth of a pixel (only without eps2d): it meets no pixel centre, but overflows gradients.
    visible &= (conic_a < 1e12f) & (conic_c < 1e12f);
    visible &= (radius_x > radius_clip) | (radius_y > radius_clip);
    visible &= (u + radius_x > 0.0f) & (u - radius_x < width) & (v + radius_y > 0.0f) & (v - radius_y < height);

    const v16 none = (v16)0.0f;
    append_rows(seen, found, row, bits(visible) & ((1u << lanes) - 1));
    if (!dense && !any(visible)) continue;
    if (with_radii) {
        const i16 rx = __builtin_convertvector(visible ? radius_x : none, i16);
        const i16 ry = __builtin_convertvector(visible ? radius_y : none, i16);
        scatter2((float*)radii, row, (v16)rx, (v16)ry, lanes);
    }
    scatter2(means2d, row, visible ? u : none, visible ? v : none, lanes);
    store_some(depths + base, visible ? z : none, lanes);
    scatter3(conics, row, visible ? conic_a : none, visible ? conic_b : none, visible ? conic_c : none, lanes);
    scatter2(sigmas, row, visible ? sigma_x : none, visible ? sigma_y : none, lanes);
    if (antialiased) store_some(compensations + base, visible ? compensation : none, lanes);
    if (raw) store_some(activated + base, visible ? opacity : none, lanes);
}
block_count[block] = found - row_begin;
