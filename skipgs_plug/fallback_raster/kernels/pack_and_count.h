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
        v16 value[RECORD] = {mx, my, along, along * (b / a), across, log2_opacity, half_h, half_w, {}, {}, {}, {},
                             -b / a, -b / c, reach, 1.0f / along};
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
        alignas(64) int box[4][16];
        *(i16*)box[0] = left >> 4, *(i16*)box[1] = right >> 4, *(i16*)box[2] = top >> 4;
        *(i16*)box[3] = empty ? (i16)-1 : bottom >> 4;
        for (int l = 0; l < lanes; ++l) {
            int* own = boxes + 4ll * (i + l);
            for (int j = 0; j < 4; ++j) own[j] = box[j][l];
            int pairs = 1;
            if (own[0] == own[1] && own[2] == own[3]) {
                ++count[own[2] * tiles_x + own[0]];
            } else {
                pairs = 0;
                const Ellipse ellipse(records + (long long)RECORD * row[l], own, width, shortcuts & EXACT_TILES);
                for (int ty = ellipse.first_row; ty <= ellipse.last_row; ++ty) {
                    int left, right;
                    ellipse.columns(ty, left, right);
                    for (int tx = left; tx <= right; ++tx) ++count[ty * tiles_x + tx];
                    if (right >= left) pairs += right - left + 1;
                }
            }
            tiles_per_gauss[row[l]] = pairs;
            of_slice += pairs;
        }
    }
    totals[s] = of_slice;
}
