// Adds up the pairs of each row of a block in a fixed order and turns their moments into gradients, of all rows where
// DENSE, else of visible ones.
#include "lib/copy_row.h"
const int row_begin = BLOCK * first, rows_here = smaller(BLOCK, rows - row_begin);
const bool more = channel > 0;
if (!more && DENSE) {
    // Cleared here and not all at once, so that the memory is still in the cache when the gradients follow.
    clear(v_means2d + 2ll * row_begin, 2 * rows_here);
    clear(v_conics + 3ll * row_begin, 3 * rows_here);
    clear(v_opacities + row_begin, rows_here);
    clear(v_colors + (long long)stride * row_begin, (long long)stride * rows_here);
}
constexpr int AHEAD = 32;  // pairs
alignas(64) const float nothing[PAIR] = {};
int j = parts > 1 ? far_block_start[first] : 0;
const int far_end = parts > 1 ? far_block_start[first + 1] : 0;
const int end = block_start[first + 1];
for (int i = block_start[first]; i < end; ++i) {
    const int g = visible[i];
    v16 sums = (v16)0.0f;
    int received = 0;
    // Slots follow the lists: those of a row lie anywhere. Which pairs were blended nobody can foresee, so that sums of
    // zero cost less than a branch.
    const auto add = [&](int from, int to, int last) INLINE {
        for (int p = from; p < to; ++p) {
            __builtin_prefetch(v_pairs + (long long)PAIR * larger(pair_slot[smaller(p + AHEAD, last)] - 1, 0));
            const int slot = pair_slot[p];
            const float* own = slot ? v_pairs + (long long)PAIR * (slot - 1) : nothing;
            sums += load(own);
            received |= slot;
        }
    };
    add(pair_start[i], pair_start[i + 1], pair_start[end] - 1);
    if (j < far_end && far_visible[j] == g) {
        add(far_pair_start[j], far_pair_start[j + 1], far_pair_start[far_end] - 1);
        ++j;
    }
    if (!received) {
        if (DENSE || more) continue;
        clear(v_means2d + 2ll * g, 2);
        clear(v_conics + 3ll * g, 3);
        clear(v_opacities + g, 1);
        clear(v_colors + (long long)stride * g, stride);
        continue;
    }
    float total[PAIR];
    store(total, sums);
    const float a = conics[3 * g], b = conics[3 * g + 1], c = conics[3 * g + 2];
    const float v_center[2] = {-(a * total[1] + b * total[2]), -(b * total[1] + c * total[2])};
    const float v_conic[3] = {0.5f * total[3], total[4], 0.5f * total[5]};
    const float v_opacity = total[0] == 0.0f ? 0.0f : -total[0] / opacities[g];
    for (int j = 0; j < 2; ++j) v_means2d[2 * g + j] = v_center[j] + (more ? v_means2d[2 * g + j] : 0.0f);
    for (int j = 0; j < 3; ++j) v_conics[3 * g + j] = v_conic[j] + (more ? v_conics[3 * g + j] : 0.0f);
    v_opacities[g] = v_opacity + (more ? v_opacities[g] : 0.0f);
    copy_row(v_colors + (long long)g * stride + channel, total + 6, channels);
    if (absgrad)
        for (int j = 0; j < 2; ++j) v_absolute[2 * g + j] += LN_4 * total[10 + j];
}
