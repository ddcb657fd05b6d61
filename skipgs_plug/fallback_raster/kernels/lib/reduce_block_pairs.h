// Adds up the sums of each row's pairs in a fixed order, for one block of rows, and turns their moments into gradients.
#pragma once
#include "record.h"
#include "simd.h"

// With `dense` the whole block is written, with zeros for rows without pairs; else only visible rows are. This function
// is inlined, so callers that pass constant flags drop the other cases.
static constexpr auto reduce_block_pairs = [](int block, const PairSums& sums, const float* conics, const float* opacities,
                                              const SplatGradients& v_splats, int n, const Channels& channels, bool dense,
                                              bool absgrad) INLINE {
    const int row_begin = BLOCK_ROWS * block, rows_here = smaller(BLOCK_ROWS, n - row_begin);
    const bool more = channels.first > 0;  // an earlier pass over the channels wrote gradients here
    const int stride = channels.stride;
    const PairSum* const slots = sums.slots;
    if (!more && dense) {
        // Clear one block at a time, so that it is still in the cache when the gradients are written.
        clear(v_splats.means2d + 2ll * row_begin, 2 * rows_here);
        clear(v_splats.conics + 3ll * row_begin, 3 * rows_here);
        clear(v_splats.opacities + row_begin, rows_here);
        clear(v_splats.colors + (long long)stride * row_begin, (long long)stride * rows_here);
    }
    // Pairs between the prefetch of a slot and its use. 16 and 64 took as long.
    constexpr int PREFETCH_PAIRS = 32;
    alignas(64) const PairSum nothing = {};
    int j = sums.parts > 1 ? sums.far_block_start[block] : 0;
    const int far_end = sums.parts > 1 ? sums.far_block_start[block + 1] : 0;
    const int end = sums.block_start[block + 1];
    for (int i = sums.block_start[block]; i < end; ++i) {
        const int g = sums.rows[i];
        v16 total = (v16)0.0f;
        int received = 0;
        // Slots are in the order of the lists, so the slots of one row are scattered. Whether a pair was blended is
        // unpredictable: adding zeros costs less than a mispredicted branch.
        const auto add = [&](int from, int to, int last) INLINE {
            for (int p = from; p < to; ++p) {
                __builtin_prefetch(slots + larger(sums.pair_slot[smaller(p + PREFETCH_PAIRS, last)] - 1, 0));
                const int slot = sums.pair_slot[p];
                const PairSum* own = slot ? slots + (slot - 1) : &nothing;
                total += load((const float*)own);
                received |= slot;
            }
        };
        add(sums.pair_start[i], sums.pair_start[i + 1], sums.pair_start[end] - 1);
        if (j < far_end && sums.far_rows[j] == g) {
            add(sums.far_pair_start[j], sums.far_pair_start[j + 1], sums.far_pair_start[far_end] - 1);
            ++j;
        }
        if (!received) {
            if (dense || more) continue;
            clear(v_splats.means2d + 2ll * g, 2);
            clear(v_splats.conics + 3ll * g, 3);
            clear(v_splats.opacities + g, 1);
            clear(v_splats.colors + (long long)stride * g, stride);
            continue;
        }
        PairSum sum;
        store((float*)&sum, total);
        const float* m = sum.moment;
        const float *const conic = conics + 3 * g, a = conic[0], b = conic[1], c = conic[2];
        const float v_center[2] = {-(a * m[OF_X] + b * m[OF_Y]), -(b * m[OF_X] + c * m[OF_Y])};
        const float v_conic[3] = {0.5f * m[OF_XX], m[OF_XY], 0.5f * m[OF_YY]};
        const float v_opacity = m[OF_1] == 0.0f ? 0.0f : -m[OF_1] / opacities[g];
        for (int j = 0; j < 2; ++j) v_splats.means2d[2 * g + j] = v_center[j] + (more ? v_splats.means2d[2 * g + j] : 0.0f);
        for (int j = 0; j < 3; ++j) v_splats.conics[3 * g + j] = v_conic[j] + (more ? v_splats.conics[3 * g + j] : 0.0f);
        v_splats.opacities[g] = v_opacity + (more ? v_splats.opacities[g] : 0.0f);
        copy_row(v_splats.colors + (long long)g * stride + channels.first, sum.color, channels.number);
        if (absgrad)
            for (int j = 0; j < 2; ++j) v_splats.absolute[2 * g + j] += LN_4 * sum.absolute[j];
    }
};
