// Adjoint of project_forward for one block of rows: 16 rows that received a gradient at a time.
#pragma once
#include "geometry.h"

// With `raw`, scales and opacities are logarithms and logits, and the gradient of the means is added to the one that
// the adjoint of the colours wrote before. Without `raw`, opacities and their gradients are not used.
//
// This function is inlined, so callers that pass constant flags and null pointers drop the other cases.
static constexpr auto project_block_adjoint =
    [](int block, const Gaussians& gaussians, const float* opacities, const Camera& camera, const RowList& visible,
       const ProjectedGradients& v_projected, const GaussianGradients& v_gaussians, float* v_opacities, float* v_poses, int n,
       bool raw, const ProjectAdjointFlags& flags) INLINE {
    v16 pose[12] = {};  // gradient of the first three rows of `camera.viewmat`, by row
    // Clear one block at a time, so that it is still in the cache when the gradients are written.
    const int row_begin = BLOCK_ROWS * block, rows = smaller(BLOCK_ROWS, n - row_begin);
    const bool empty = visible.block_start[block] == visible.block_start[block + 1];
    const auto clear_rows = [=](float* p, long long n) { empty ? clear_past_caches(p, n) : clear(p, n); };
    if (!raw) clear_rows(v_gaussians.means + 3ll * row_begin, 3 * rows);
    clear_rows(v_gaussians.quats + 4ll * row_begin, 4 * rows);
    clear_rows(v_gaussians.scales + 3ll * row_begin, 3 * rows);
    if (raw) clear_rows(v_opacities + row_begin, rows);
    // Where most visible rows lie behind others, few received a gradient. All other rows are zero already.
    alignas(64) int received[BLOCK_ROWS];
    int count = 0;
    for (int i = visible.block_start[block]; i < visible.block_start[block + 1]; i += 16) {
        const int lanes = smaller(16, visible.block_start[block + 1] - i);
        int row[16];
        next_rows(visible.rows + i, lanes, row);
        v16 center[2], conic[3], single[2] = {};
        gather2(v_projected.means2d, row, center);
        gather3(v_projected.conics, row, n, conic);
        if (flags.with_depth) single[0] = gather(v_projected.depths, row, 1, 0);
        if (raw) single[1] = gather(v_projected.opacities, row, 1, 0);
        else if (flags.antialiased) single[1] = gather(v_projected.compensations, row, 1, 0);
        i16 some = (single[0] != 0.0f) | (single[1] != 0.0f) | (center[0] != 0.0f) | (center[1] != 0.0f);
        for (int j = 0; j < 3; ++j) some |= conic[j] != 0.0f;
        append_rows(received, count, row, (flags.optimizations & CONTRIBUTED_ONLY ? bits(some) : ~0u) & ((1u << lanes) - 1));
    }
    for (int base = 0; base < count; base += 16) {
        const int lanes = smaller(16, count - base);
        int row[16];
        next_rows(received + base, lanes, row);
        v16 v_center[2], v_conic[3], v_depth = (v16)0.0f, v_comp = (v16)0.0f;
        gather2(v_projected.means2d, row, v_center);
        gather3(v_projected.conics, row, n, v_conic);
        v16 v_u = v_center[0], v_v = v_center[1], va = v_conic[0], vb = 0.5f * v_conic[1], vc = v_conic[2];
        if (flags.with_depth) v_depth = gather(v_projected.depths, row, 1, 0);
        if (flags.antialiased && !raw) v_comp = gather(v_projected.compensations, row, 1, 0);
        v16 v_alpha = (v16)0.0f, opacity = (v16)0.0f;
        if (raw) {
            v_alpha = gather(v_projected.opacities, row, 1, 0);
            opacity = sigmoid(gather(opacities, row, 1, 0));
            if (flags.antialiased) v_comp = v_alpha * opacity;
        }
        v16 S[3];
        gather3(gaussians.scales, row, n, S);
        if (raw)
            for (int j = 0; j < 3; ++j) S[j] = vexp(S[j]);
        const Centers center = centers(camera, gaussians.means, row, n);
        const v16 x = center.x, y = center.y, iz = 1.0f / center.z;
        const Projection p = project_rows(camera, gaussians.quats, row, center, iz, S);
        // Copies on purpose: with references Clang fuses other products, which changes the last bits of gradients.
        const Covariances cov = p.cov;
        const SplatAxes axes = p.axes;
        const Rotations rotation = p.rotation;
        const v16(&R)[3][3] = rotation.R;

        if (raw) {
            const v16 v_opacity = flags.antialiased ? v_alpha * vsqrt(cov.sharp_det / cov.det) : v_alpha;
            scatter(v_opacities, row, v_opacity * opacity * (1.0f - opacity), lanes);
        }

        // Extreme cameras, with a principal point 1e5 image widths away, leave the range of float. A huge gradient is
        // better than infinity, because infinity minus infinity is NaN. Gradients of usual scenes stay far below these
        // bounds.
        auto saturated = [](v16 v, float most) -> v16 { return v > most ? (v16)most : (v < -most ? (v16)-most : v); };
        v_u = saturated(v_u, 1e20f); v_v = saturated(v_v, 1e20f);
        va = saturated(va, 1e12f); vb = saturated(vb, 1e12f); vc = saturated(vc, 1e12f);

        // Inverse of a matrix: v_cov = -conic v_conic conic, all symmetric.
        v16 pa = cov.conic_a * va + cov.conic_b * vb, pb = cov.conic_a * vb + cov.conic_b * vc;
        v16 pc = cov.conic_b * va + cov.conic_c * vb, pd = cov.conic_b * vb + cov.conic_c * vc;
        v16 v_xx = -(pa * cov.conic_a + pb * cov.conic_b), v_xy = -(pa * cov.conic_b + pb * cov.conic_c);
        v16 v_yy = -(pc * cov.conic_b + pd * cov.conic_c);
        if (flags.antialiased) {
            // compensation = sqrt(sharp det / det); both determinants here are divided by cov.xx.
            v16 half_comp = cov.sharp_det > 1e-30f ? 0.5f * v_comp * vsqrt(cov.sharp_det / cov.det) : (v16)0.0f;
            v16 i_sharp = 1.0f / vmax(cov.sharp_det, (v16)1e-30f), i_blurred = 1.0f / cov.det;
            v_xx += half_comp * (cov.sharp_yy / cov.xx * i_sharp - cov.yy / cov.xx * i_blurred);
            v_yy += half_comp * (cov.sharp_xx / cov.xx * i_sharp - i_blurred);
            v_xy += half_comp * cov.slope * (i_blurred - i_sharp);
        }

        v_xx = saturated(v_xx, 1e15f); v_xy = saturated(v_xy, 1e15f); v_yy = saturated(v_yy, 1e15f);
        v16 v_WM[3][3], v_J00 = (v16)0.0f, v_J02 = v_J00, v_J11 = v_J00, v_J12 = v_J00;
        for (int j = 0; j < 3; ++j) {
            v16 v_T0 = saturated(2.0f * (v_xx * axes.T0[j] + v_xy * axes.T1[j]), 1e20f);
            v16 v_T1 = saturated(2.0f * (v_xy * axes.T0[j] + v_yy * axes.T1[j]), 1e20f);
            v_J00 += v_T0 * axes.WM[0][j];
            v_J02 += v_T0 * axes.WM[2][j];
            v_J11 += v_T1 * axes.WM[1][j];
            v_J12 += v_T1 * axes.WM[2][j];
            v_WM[0][j] = axes.J00 * v_T0;
            v_WM[1][j] = axes.J11 * v_T1;
            v_WM[2][j] = axes.J02 * v_T0 + axes.J12 * v_T1;
        }

        v_J00 = saturated(v_J00, 1e20f); v_J02 = saturated(v_J02, 1e20f);
        v_J11 = saturated(v_J11, 1e20f); v_J12 = saturated(v_J12, 1e20f);
        // Projection: u = fx x / z + cx; J00 = fx / z; J02 = -fx ux / z with ux = x / z where it is not clamped.
        v16 inside_x = axes.ux == x * iz ? (v16)1.0f : (v16)0.0f, inside_y = axes.uy == y * iz ? (v16)1.0f : (v16)0.0f;
        v16 v_tx = v_u - inside_x * v_J02 * iz, v_ty = v_v - inside_y * v_J12 * iz;
        const Intrinsics focal = intrinsics(camera);
        v16 v_x = saturated(focal.fx * iz * v_tx, 1e20f), v_y = saturated(focal.fy * iz * v_ty, 1e20f);
        // Fused by hand: which product Clang fuses with a sum depends on the surrounding code.
        const v16 along_J =
            __builtin_elementwise_fma(axes.J00, v_J00, axes.J02 * v_J02) + axes.J11 * v_J11 + axes.J12 * v_J12;
        v16 v_z = v_depth - iz * (x * v_x + y * v_y) - iz * along_J;

        v_z = saturated(v_z, 1e20f);
        const float* V = camera.viewmat;
        v16 v_mean[3], v_M[3][3];
        for (int i = 0; i < 3; ++i) {
            v_mean[i] = V[i] * v_x + V[4 + i] * v_y + V[8 + i] * v_z;
            for (int j = 0; j < 3; ++j)
                v_M[i][j] = saturated(V[i] * v_WM[0][j] + V[4 + i] * v_WM[1][j] + V[8 + i] * v_WM[2][j], 1e30f);
        }
        if (flags.with_pose) {
            const i16 in_use = lane < (float)lanes;
            const v16 v_camera[3] = {v_x, v_y, v_z};
            for (int i = 0; i < 3; ++i) {
                v16 v = in_use ? v_camera[i] : (v16)0.0f;
                pose[4 * i] += v * center.world[0];
                pose[4 * i + 1] += v * center.world[1];
                pose[4 * i + 2] += v * center.world[2];
                pose[4 * i + 3] += v;
                for (int k = 0; k < 3; ++k)
                    for (int j = 0; j < 3; ++j)
                        pose[4 * i + k] += in_use ? v_WM[i][j] * R[k][j] * S[j] : (v16)0.0f;
            }
        }

        if (raw) {
            v16 of_colors[3];
            gather3(v_gaussians.means, row, n, of_colors);
            for (int i = 0; i < 3; ++i) v_mean[i] = of_colors[i] + v_mean[i];
        }
        scatter3(v_gaussians.means, row, v_mean[0], v_mean[1], v_mean[2], lanes);
        v16 v_scale[3];
        for (int j = 0; j < 3; ++j) {
            v_scale[j] = v_M[0][j] * R[0][j] + v_M[1][j] * R[1][j] + v_M[2][j] * R[2][j];
            if (raw) v_scale[j] *= S[j];
        }
        scatter3(v_gaussians.scales, row, v_scale[0], v_scale[1], v_scale[2], lanes);
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) v_M[i][j] *= 2.0f * S[j];
        const v16 qw = rotation.w, qx = rotation.x, qy = rotation.y, qz = rotation.z;
        v16 v_qw = qx * (v_M[2][1] - v_M[1][2]) + qy * (v_M[0][2] - v_M[2][0]) + qz * (v_M[1][0] - v_M[0][1]);
        v16 v_qx = qw * (v_M[2][1] - v_M[1][2]) + qy * (v_M[0][1] + v_M[1][0]) + qz * (v_M[0][2] + v_M[2][0])
                 - 2.0f * qx * (v_M[1][1] + v_M[2][2]);
        v16 v_qy = qw * (v_M[0][2] - v_M[2][0]) + qx * (v_M[0][1] + v_M[1][0]) + qz * (v_M[1][2] + v_M[2][1])
                 - 2.0f * qy * (v_M[0][0] + v_M[2][2]);
        v16 v_qz = qw * (v_M[1][0] - v_M[0][1]) + qx * (v_M[0][2] + v_M[2][0]) + qy * (v_M[1][2] + v_M[2][1])
                 - 2.0f * qz * (v_M[0][0] + v_M[1][1]);
        v16 along = qw * v_qw + qx * v_qx + qy * v_qy + qz * v_qz;
        v16 back = rotation.norm * rotation.scale;
        scatter4(v_gaussians.quats, row, saturated((v_qw - along * qw) * back, 1e38f),
                 saturated((v_qx - along * qx) * back, 1e38f), saturated((v_qy - along * qy) * back, 1e38f),
                 saturated((v_qz - along * qz) * back, 1e38f), lanes);
    }
    if (flags.with_pose)
        for (int i = 0; i < 12; ++i) v_poses[12 * block + i] = sum(pose[i]);
};
