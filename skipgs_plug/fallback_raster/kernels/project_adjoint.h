// Gradients of means, rotations, scales and the camera's pose.
//
// Reads the gradients of visible rows. Writes `v_gaussians` and the partial sum `v_poses` of its own block. No other
// thread writes to that block.
#pragma once
#include "lib/project_block_adjoint.h"
static constexpr auto project_adjoint = [](const Gaussians& gaussians, const Camera& camera, const RowList& visible,
                                           const ProjectedGradients& v_projected, const GaussianGradients& v_gaussians,
                                           float* v_poses, int n, const ProjectAdjointFlags& flags, int first,
                                           int last) INLINE {
    project_block_adjoint(first, gaussians, nullptr, camera, visible, v_projected, v_gaussians, nullptr, v_poses, n,
                          /* raw */ false, flags);
};
