// The sums of the pairs of each row of a block, added up in a fixed order, and their moments as gradients.
#pragma once
#include "record.h"
#include "simd.h"

// Of all rows where `dense`, which is then written whole, else of visible ones. Constants in place of the flags leave out
// what they rule out: this is inlined.
static constexpr auto reduce_block_pairs = [](int block, const PairSums& sums, const float* conics, const float* opacities,
                                              const SplatGradients& v_splats, int n, const Channels& channels, int dense,
                                              int absgrad, int parts) INLINE {
    const int row_begin = BLOCK * block, rows_here = smaller(BLOCK, n - row_begin);
    const bool more = channels.first > 0;  // an earlier pass over the channels was here
    const int stride = channels.stride;
    const PairSum* const slots = (const PairSum*)sums.slots;
    if (!more && dense) {
        // Cleared here and not all at once, so that the memory is still in the cache when the gradients follow.
        clear(v_splats.means2d + 2ll * row_begin, 2 * rows_here);
        clear(v_splats.conics + 3ll * row_begin, 3 * rows_here);
        clear(v_splats.opacities + row_begin, rows_here);
        clear(v_splats.colors + (long long)stride * row_begin, (long long)stride * rows_here);
    }
    // Pairs between a prefetch and the use of its sums: 16 and 64 took as long.
    constexpr int AHEAD = 32;
    alignas(64) const PairSum nothing = {};
    int j = parts > 1 ? sums.far_block_start[block] : 0;
    const int far_end = parts > 1 ? sums.far_block_start[block + 1] : 0;
    const int end = sums.block_start[block + 1];
    for (int i = sums.block_start[block]; i < end; ++i) {
        const int g = sums.rows[i];
        v16 total = (v16)0.0f;
        int received = 0;
        // Slots follow the lists: those of a row lie anywhere. Which pairs were blended nobody can foresee, so that sums of
        // zero cost less than a branch.
        const auto add = [&](int from, int to, int last) INLINE {
            for (int p = from; p < to; ++p) {
                __builtin_prefetch(slots + larger(sums.pair_slot[smaller(p + AHEAD, last)] - 1, 0));
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
        const float a = conics[3 * g], b = conics[3 * g + 1], c = conics[3 * g + 2];
        const float v_center[2] = {-(a * m[1] + b * m[2]), -(b * m[1] + c * m[2])};
        const float v_conic[3] = {0.5f * m[3], m[4], 0.5f * m[5]};
        const float v_opacity = m[0] == 0.0f ? 0.0f : -m[0] / opacities[g];
        for (int j = 0; j < 2; ++j) v_splats.means2d[2 * g + j] = v_center[j] + (more ? v_splats.means2d[2 * g + j] : 0.0f);
        for (int j = 0; j < 3; ++j) v_splats.conics[3 * g + j] = v_conic[j] + (more ? v_splats.conics[3 * g + j] : 0.0f);
        v_splats.opacities[g] = v_opacity + (more ? v_splats.opacities[g] : 0.0f);
        copy_row(v_splats.colors + (long long)g * stride + channels.first, sum.color, channels.number);
        if (absgrad)
            for (int j = 0; j < 2; ++j) v_splats.absolute[2 * g + j] += LN_4 * sum.absolute[j];
    }
};
