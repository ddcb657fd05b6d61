// Gradients of means, SH coefficients and the camera's position.
//
// Reads the gradients of the colours of visible rows. Writes `v_means`, `v_sh` and the partial sum `v_positions` of its
// own block. No other thread writes to that block.
#pragma once
#include "lib/sh_block_adjoint.h"
static constexpr auto sh_adjoint = [](const float* means, const Harmonics& sh, const RowList& visible, const float* colors,
                                      const float* v_colors, float* v_means, const HarmonicsGradients& v_sh,
                                      float* v_positions, int n, int optimizations, int first, int last) INLINE {
    const FactorOutput no_factors = {nullptr, nullptr};
    const HarmonicsGradients v_dense = {v_sh.sh0, v_sh.shN, /* factored */ 0};
    sh_block_adjoint(first, means, sh, visible, colors, v_colors, v_means, v_dense, no_factors, v_positions + 3 * first, n,
                     /* with_position */ true, optimizations);
};
