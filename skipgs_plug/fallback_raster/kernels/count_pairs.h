// Number of (tile, Gaussian) pairs of each tile, by slice of the depth order.
#include "ellipse.h"
const int tiles = tiles_x * tiles_y;
for (int s = first; s < last; ++s) {
    int* count = counts + (long long)s * tiles;
    for (int t = 0; t < tiles; ++t) count[t] = 0;
    for (int i = (long long)s * n / slices; i < (long long)(s + 1) * n / slices; ++i) {
        // Depth order is no order of rows: every record is far from the last.
        __builtin_prefetch(records + (long long)RECORD * order[smaller(i + 16, n - 1)]);
        const Ellipse ellipse(records + (long long)RECORD * order[i], width, height, shortcuts & EXACT_TILES);
        int pairs = 0;
        for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
            int left, right;
            ellipse.columns(ty, left, right);
            for (int tx = left; tx <= right; ++tx) ++count[ty * tiles_x + tx];
            if (right >= left) pairs += right - left + 1;
        }
        tiles_per_gauss[order[i]] = pairs;
    }
}
