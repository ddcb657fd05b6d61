// Lists the Gaussians of each tile front to back, and for each Gaussian its places in the lists.
#include "ellipse.h"
for (int s = first; s < last; ++s) {
    int* next = counts + (long long)s * tiles_x * tiles_y;
    for (int i = (long long)s * n / slices; i < (long long)(s + 1) * n / slices; ++i) {
        const int g = order[i];
        // Depth order is no order of rows: every record is far from the last.
        __builtin_prefetch(records + (long long)RECORD * order[smaller(i + 16, n - 1)]);
        const Ellipse ellipse(records + (long long)RECORD * g, width, height, shortcuts & EXACT_TILES);
        int pair = pair_start[g];
        for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
            int left, right;
            ellipse.columns(ty, left, right);
            for (int tx = left; tx <= right; ++tx) {
                const int slot = next[ty * tiles_x + tx]++;
                tile_list[slot] = g;
                pair_slot[pair++] = slot;
            }
        }
    }
}
