// Lists the pairs of each tile, as yet in the order of the rows: depth in the upper half, number of the pair in the lower.
// Pairs are numbered by row and tile. Depths are positive, so their bits sort like integers.
#include "ellipse.h"
for (int s = first; s < last; ++s) {
    int* next = counts + (long long)s * tiles_x * tiles_y;
    int pair = (int)totals[s];
    const int begin = (int)((long long)s * n / slices), end = (int)((long long)(s + 1) * n / slices);
    for (int i = begin; i < end; ++i) {
        const int g = visible[i];
        const long long key = (long long)((const int*)depths)[g] << 32;
        pair_start[i] = pair;
        const int* box = boxes + (long long)BOX * i;
        if (box[4] >= 0) {
            int* corner = next + box[2] * tiles_x + box[0];
            for (int rest = box[4]; rest; rest &= rest - 1) {
                const int j = __builtin_ctz(rest);
                pair_row[pair] = g;
                unsorted[corner[(j >> 1) * tiles_x + (j & 1)]++] = key | (unsigned)pair++;
            }
            continue;
        }
        const Ellipse ellipse(records + (long long)RECORD * g, box, width, shortcuts & EXACT_TILES);
        for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
            int left, right;
            ellipse.columns(ty, left, right);
            for (int tx = left; tx <= right; ++tx) {
                pair_row[pair] = g;
                unsorted[next[ty * tiles_x + tx]++] = key | (unsigned)pair++;
            }
        }
    }
    if (s == slices - 1) pair_start[n] = pair;
}
