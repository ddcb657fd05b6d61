// Gradients of raw parameters from the sums of pairs, one block of rows at a time. Intermediate gradients stay in the
// cache.
//
// Reads the slots of the pairs, and the parameters and forward results of visible rows. Writes all gradients of its own
// block, and adds to `v_centers.absolute`. No other thread writes to that block.
#pragma once
#include "lib/project_block_adjoint.h"
#include "lib/reduce_block_pairs.h"
#include "lib/sh_block_adjoint.h"
static constexpr auto splat_adjoint =
    [](const PairSums& sums, const Gaussians& gaussians, const float* logits, const Camera& camera, const Harmonics& sh,
       const Rendered& rendered, const GaussianGradients& v_gaussians, float* v_logits, const HarmonicsGradients& v_sh,
       const FactorOutput& factors, const CenterGradients& v_centers, int n,
       const SplatAdjointFlags& flags, int first, int last) INLINE {
        // The functions below index rows from row 0 of all, so these buffers of one block are addressed relative to it.
        // Vector loads may read the padding behind the last row; its content does not matter.
        alignas(64) float center[2 * BLOCK_ROWS], conic[3 * BLOCK_ROWS + 16], alpha[BLOCK_ROWS];
        alignas(64) float color[3 * BLOCK_ROWS + 16], magnitude[2 * BLOCK_ROWS];
        const auto counted = [=](float* p, int width) INLINE -> float* {
            return (float*)((unsigned long long)p - sizeof(float) * width * BLOCK_ROWS * first);
        };
        const SplatGradients v_splats = {counted(center, 2), counted(conic, 3), counted(alpha, 1), counted(magnitude, 2),
                                         counted(color, 3)};
        if (flags.absgrad) clear(magnitude, 2 * BLOCK_ROWS);
        const Channels channels = {/* stride */ 3, /* first */ 0, /* number */ 3};
        reduce_block_pairs(first, sums, rendered.conics, rendered.opacities, v_splats, n, channels, /* dense */ false,
                           flags.absgrad);
        for (int i = sums.block_start[first]; i < sums.block_start[first + 1]; ++i)
            for (int j = 0; j < 2; ++j) {
                if (flags.with_centers) v_centers.centers[2 * i + j] = v_splats.means2d[2 * sums.rows[i] + j];
                if (flags.absgrad) v_centers.absolute[2 * i + j] += v_splats.absolute[2 * sums.rows[i] + j];
            }
        const RowList visible = {sums.rows, sums.block_start};
        // Strides of raw parameters as constants, so that the compiler drops the other cases.
        const Harmonics raw_sh = {sh.position,   sh.sh0,         sh.shN, /* sh0_stride */ 3,
                                  sh.shN_stride, /* shN_offset */ 0, sh.degree};
        sh_block_adjoint(first, gaussians.means, raw_sh, visible, rendered.colors, v_splats.colors, v_gaussians.means, v_sh,
                         factors, /* v_position */ nullptr, n, /* with_position */ false, flags.optimizations);
        const ProjectedGradients v_projected = {v_splats.means2d, /* depths */ nullptr, v_splats.conics,
                                                /* compensations */ nullptr, v_splats.opacities};
        project_block_adjoint(first, gaussians, logits, camera, visible, v_projected, v_gaussians, v_logits,
                              /* v_poses */ nullptr, n, /* raw */ true,
                              {/* with_depth */ 0, flags.antialiased, /* with_pose */ 0, flags.optimizations});
    };
