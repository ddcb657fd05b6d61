// Records of the visible rows, the boxes of tiles around them, and the number of pairs of each tile, by slice of the rows.
#include "ellipse.h"
const int tiles = tiles_x * tiles_y;
for (int s = first; s < last; ++s) {
    int* count = counts + (long long)s * tiles;
    for (int t = 0; t < tiles; ++t) count[t] = 0;
    long long of_slice = 0;
    const int begin = (int)((long long)s * n / slices), end = (int)((long long)(s + 1) * n / slices);
    for (int i = begin; i < end; i += 16) {
        const int lanes = smaller(16, end - i);
        int row[16];
        for (int l = 0; l < 16; ++l) row[l] = visible[i + smaller(l, lanes - 1)];
        v16 a = gather(conics, row, 3, 0), b = gather(conics, row, 3, 1), c = gather(conics, row, 3, 2);
        v16 log2_opacity = log2(vmax(gather(opacities, row, 1, 0), (v16)1e-20f));
        v16 reach = log2_opacity - LOG2_ALPHA_MIN;
        // a dx^2 + 2 b dx dy + c dy^2 = a (dx + b / a dy)^2 + dy^2 / sigma_y^2: no needle rounds to a negative value.
        v16 along = vsqrt(0.5f * LOG2_E * a), across = vsqrt((v16)(0.5f * LOG2_E)) / gather(sigmas, row, 2, 1);
        // Half axes of the box around alpha >= ALPHA_MIN, a hair wider than exact: the blend tests every pixel itself.
        v16 half = vsqrt(vmax(2.0f * reach / LOG2_E, (v16)0.0f)) * 1.0001f + 1e-3f;
        v16 mx = gather(means2d, row, 2, 0), my = gather(means2d, row, 2, 1);
        v16 half_w = half * gather(sigmas, row, 2, 0), half_h = half * gather(sigmas, row, 2, 1);
        const v16 slope = b / a;
        v16 value[RECORD] = {mx, my, along, along * slope, across, log2_opacity, half_h, half_w, {}, {}, {}, {},
                             -slope, -b / c, reach, 1.0f / along};
        for (int k = 0; k < channels; ++k) value[8 + k] = gather(colors, row, stride, k);
        transpose(value);
        for (int l = 0; l < lanes; ++l) store(records + (long long)RECORD * row[l], value[l]);

        // Pixels whose centres the box holds. Clamped before they become integers: what lies far outside is beyond them.
        auto clamped = [](v16 x, float low, float high) -> i16 {
            return __builtin_convertvector(vmin(vmax(x, (v16)low), (v16)high), i16);
        };
        const i16 left = clamped(__builtin_elementwise_ceil(mx - half_w - 0.5f), 0.0f, width);
        const i16 right = clamped(__builtin_elementwise_floor(mx + half_w - 0.5f), -1.0f, width - 1.0f);
        const i16 top = clamped(__builtin_elementwise_ceil(my - half_h - 0.5f), 0.0f, height);
        const i16 bottom = clamped(__builtin_elementwise_floor(my + half_h - 0.5f), -1.0f, height - 1.0f);
        static_assert(TILE == 16, "pixels to tiles");
        const i16 empty = (left > right) | (top > bottom);
        alignas(64) int box[BOX][16];
        const i16 first_column = left >> 4, last_column = right >> 4, first_row = top >> 4, last_row = bottom >> 4;
        *(i16*)box[0] = first_column, *(i16*)box[1] = last_column, *(i16*)box[2] = first_row;
        *(i16*)box[3] = empty ? (i16)-1 : last_row;
        // Which of the four tiles of a box of at most 2 x 2 the ellipse meets, or a hair more: a convex function is least
        // at the point nearest to the centre or on an edge that faces it.
        i16 meets = (i16)0;
        for (int j = 0; j < 4; ++j) {
            const v16 x0 = 16.0f * __builtin_convertvector(first_column + j % 2, v16) + 0.5f - mx, x1 = x0 + 15.0f;
            const v16 y0 = 16.0f * __builtin_convertvector(first_row + j / 2, v16) + 0.5f - my, y1 = y0 + 15.0f;
            const v16 near_x = vmax(x0, vmin(x1, (v16)0.0f)), near_y = vmax(y0, vmin(y1, (v16)0.0f));
            const v16 at_y = vmax(y0, vmin(y1, -b / c * near_x)), at_x = vmax(x0, vmin(x1, -slope * near_y));
            const v16 p = along * (near_x + slope * at_y), w = across * at_y;
            const v16 q = along * (at_x + slope * near_y), u = across * near_y;
            const i16 meets_it = (vmin(p * p + w * w, q * q + u * u) <= reach + 0.01f) | !(shortcuts & EXACT_TILES);
            const i16 in_box = (first_column + j % 2 <= last_column) & (first_row + j / 2 <= last_row);
            meets |= meets_it & in_box & (1 << j);
        }
        const i16 small = (last_column - first_column <= 1) & (last_row - first_row <= 1);
        *(i16*)box[4] = empty ? (i16)0 : (small ? meets : (i16)-1);
        for (int l = 0; l < lanes; ++l) {
            int* own = boxes + (long long)BOX * (i + l);
            for (int j = 0; j < BOX; ++j) own[j] = box[j][l];
            int pairs = 0;
            if (own[4] >= 0) {
                int* corner = count + own[2] * tiles_x + own[0];
                for (int rest = own[4]; rest; rest &= rest - 1) {
                    const int j = __builtin_ctz(rest);
                    ++corner[(j >> 1) * tiles_x + (j & 1)];
                }
                pairs = __builtin_popcount(own[4]);
            } else {
                const Ellipse ellipse(records + (long long)RECORD * row[l], own, width, shortcuts & EXACT_TILES);
                for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
                    int left, right;
                    ellipse.columns(ty, left, right);
                    for (int tx = left; tx <= right; ++tx) ++count[ty * tiles_x + tx];
                    if (right >= left) pairs += right - left + 1;
                }
            }
            if (dense) tiles_per_gauss[row[l]] = pairs;
            of_slice += pairs;
        }
    }
    totals[s] = of_slice;
}
