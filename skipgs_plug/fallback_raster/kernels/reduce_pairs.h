// Adds up the sums of each row's pairs, and turns their moments into gradients.
//
// Reads the slots of the pairs. Writes `v_splats` of its own block; from the second pass over the channels on it adds
// to them. No other thread writes to that block.
#pragma once
#include "lib/reduce_block_pairs.h"
static constexpr auto reduce_pairs = [](const PairSums& sums, const float* conics, const float* opacities,
                                        const SplatGradients& v_splats, int n, const Channels& channels, int absgrad,
                                        int first, int last) INLINE {
    reduce_block_pairs(first, sums, conics, opacities, v_splats, n, channels, /* dense */ true, absgrad);
};
