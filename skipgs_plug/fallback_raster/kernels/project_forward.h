// Projects one block of rows: 2D mean, depth, conic and extent of each Gaussian, and the list of visible rows.
//
// Reads the Gaussians and the camera. Writes `projected` and `found` for the rows of its own block. No other thread
// writes to that block.
#pragma once
#include "lib/geometry.h"
static constexpr auto project_forward = [](const Gaussians& gaussians, const float* opacities, const Camera& camera,
                                           const Limits& limits, const Projected& projected, const BlockRows& found, int n,
                                           const ProjectFlags& flags, int first, int last) INLINE {
    const int block = first, row_begin = BLOCK_ROWS * block, row_end = smaller(row_begin + BLOCK_ROWS, n);
    int end = row_begin;
    for (int base = row_begin; base < row_end; base += 16) {
        const int lanes = smaller(16, row_end - base);
        int row[16];
        for (int l = 0; l < 16; ++l) row[l] = base + (l < lanes ? l : lanes - 1);
        v16 S[3];
        gather3(gaussians.scales, row, n, S);
        const Centers center = centers(camera, gaussians.means, row, n);
        const v16 z = center.z, iz = 1.0f / z;
        // Cull 16 rows without their rotations if all lie outside the image even as spheres of their longest axis.
        // Gaussians near each other in space often lie near each other in memory. The tests let NaN through to the full
        // test below.
        v16 longest = vmax(vmax(vabs(S[0]), vabs(S[1])), vabs(S[2]));
        if (flags.raw) longest = vexp(vmax(vmax(S[0], S[1]), S[2]));
        i16 outside = (z < limits.near_plane) | (z > limits.far_plane);
        if (flags.optimizations & SPHERES) outside |= beyond(camera, center, iz, longest);
        if (!any(~outside)) {
            if (flags.dense) {
                if (flags.with_radii) clear((float*)projected.radii + 2ll * base, 2 * lanes);
                clear(projected.means2d + 2ll * base, 2 * lanes);
                clear(projected.depths + base, lanes);
                clear(projected.conics + 3ll * base, 3 * lanes);
                clear(projected.sigmas + 2ll * base, 2 * lanes);
                if (flags.antialiased) clear(projected.compensations + base, lanes);
            }
            continue;
        }
        if (flags.raw)
            for (int j = 0; j < 3; ++j) S[j] = vexp(S[j]);
        const Covariances cov = project_rows(camera, gaussians.quats, row, center, iz, S).cov;

        v16 compensation = (v16)1.0f;
        if (flags.antialiased) compensation = vsqrt(cov.sharp_det / cov.det);
        v16 opacity = gather(opacities, row, 1, 0);
        if (flags.raw) opacity = sigmoid(opacity);
        if (flags.antialiased) opacity *= compensation;
        // Each comparison is false for NaN, so a Gaussian with a NaN anywhere is culled.
        i16 visible = (z >= limits.near_plane) & (z <= limits.far_plane) & (cov.det > 0.0f) & (opacity >= ALPHA_MIN);
        v16 reach = vmin((v16)MAX_DEVIATIONS, vsqrt(LN_4 * log2(255.0f * vmax(opacity, (v16)1e-3f))));
        const auto [fx, fy, cx, cy] = intrinsics(camera);
        v16 u = fx * center.x * iz + cx, v = fy * center.y * iz + cy;
        v16 sigma_x = vsqrt(cov.xx), sigma_y = vsqrt(cov.yy);
        v16 radius_x = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_x));
        v16 radius_y = vmin((v16)1e9f, __builtin_elementwise_ceil(reach * sigma_y));
        // Thinner than a millionth of a pixel, which only happens without eps2d: it meets no pixel centre, and its
        // gradient would overflow.
        visible &= (cov.conic_a < 1e12f) & (cov.conic_c < 1e12f);
        visible &= (radius_x > limits.radius_clip) | (radius_y > limits.radius_clip);
        visible &= (u + radius_x > 0.0f) & (u - radius_x < camera.width);
        visible &= (v + radius_y > 0.0f) & (v - radius_y < camera.height);

        const v16 none = (v16)0.0f;
        append_rows(found.rows, end, row, bits(visible) & ((1u << lanes) - 1));
        if (!flags.dense && !any(visible)) continue;
        if (flags.with_radii) {
            const i16 rx = __builtin_convertvector(visible ? radius_x : none, i16);
            const i16 ry = __builtin_convertvector(visible ? radius_y : none, i16);
            scatter2((float*)projected.radii, row, (v16)rx, (v16)ry, lanes);
        }
        scatter2(projected.means2d, row, visible ? u : none, visible ? v : none, lanes);
        store_some(projected.depths + base, visible ? z : none, lanes);
        scatter3(projected.conics, row, visible ? cov.conic_a : none, visible ? cov.conic_b : none,
                 visible ? cov.conic_c : none, lanes);
        scatter2(projected.sigmas, row, visible ? sigma_x : none, visible ? sigma_y : none, lanes);
        if (flags.antialiased) store_some(projected.compensations + base, visible ? compensation : none, lanes);
        if (flags.raw) store_some(projected.opacities + base, visible ? opacity : none, lanes);
    }
    found.counts[block] = end - row_begin;
};
