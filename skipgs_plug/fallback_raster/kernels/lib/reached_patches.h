// Finds the patches of a tile that the ellipses alpha = ALPHA_MIN of some Gaussians reach, as bits. It finds slightly
// more than the exact patches, because every pixel is tested again.
//
// A lane stands for one Gaussian and one line of patches. The part of an ellipse inside a line is convex, so it meets
// all columns between its leftmost and its rightmost point. These are the extreme points of the whole ellipse, clamped
// to the line.
#pragma once
#include "blend_tile.h"
static constexpr int TESTED_AT_ONCE = 16 / PATCH_LINES;  // Gaussians that fill the 16 lanes
#ifdef __AVX512F__
static constexpr v16 line = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
#else
static constexpr v16 line = {0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f, 0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f};
#endif
static constexpr auto reached_patches = [](const Record* const* r, int x0, int y0, unsigned* reached) INLINE {
#pragma clang fp contract(fast)
    // One field of each record, number `c` of its floats, repeated for each line.
    auto column = [r](int c) INLINE -> v16 {
#ifdef __AVX512F__
        v4 of[4];
        for (int g = 0; g < 4; ++g) of[g] = *(const v4*)((const float*)r[g] + c / 4 * 4);
        const v16 all = join(of);
        switch (c % 4) {
            case 0: return __builtin_shufflevector(all, all, 0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12);
            case 1: return __builtin_shufflevector(all, all, 1, 1, 1, 1, 5, 5, 5, 5, 9, 9, 9, 9, 13, 13, 13, 13);
            case 2: return __builtin_shufflevector(all, all, 2, 2, 2, 2, 6, 6, 6, 6, 10, 10, 10, 10, 14, 14, 14, 14);
            default: return __builtin_shufflevector(all, all, 3, 3, 3, 3, 7, 7, 7, 7, 11, 11, 11, 11, 15, 15, 15, 15);
        }
#else
        return __builtin_shufflevector((v8)((const float*)r[0])[c], (v8)((const float*)r[1])[c],  //
                                       0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
#endif
    };
#define FIELD(name) column(__builtin_offsetof(Record, name) / sizeof(float))
    const v16 half_h = FIELD(half_height), slope = FIELD(row_slope), across = FIELD(across), chord = FIELD(inverse_along);
    const v16 extreme = FIELD(column_slope) * FIELD(half_width), reach = FIELD(reach) + 0.01f;
    // Distance from the centre to the first and to the last row of pixels of the line.
    const v16 first = (float)PATCH_ROWS * line + (y0 + 0.5f) - FIELD(y);
    const v16 low = vmax(first, -half_h), high = vmin(first + (PATCH_ROWS - 1.0f), half_h);
    const v16 dy_left = vmin(vmax(-extreme, low), high), dy_right = vmin(vmax(extreme, low), high);
    const v16 w_left = across * dy_left, w_right = across * dy_right;
    const v16 half_left = vsqrt(vmax(reach - w_left * w_left, (v16)0.0f));
    const v16 half_right = vsqrt(vmax(reach - w_right * w_right, (v16)0.0f));
    // In units of patch columns, measured from the centre of the first pixel of the tile.
    const v16 centre = FIELD(x) - (x0 + 0.5f);
    const v16 left = 0.25f * (centre + slope * dy_left - chord * half_left) - (0.75f + 0.005f);
    const v16 right = 0.25f * (centre + slope * dy_right + chord * half_right) + 0.005f;
    const v16 begin = __builtin_elementwise_ceil(vmax(vmin(left, (v16)4.0f), (v16)0.0f));
    const v16 end = __builtin_elementwise_floor(vmax(vmin(right, (v16)3.0f), (v16)-1.0f)) + 1.0f;
    i16 columns = ((i16)15 << __builtin_convertvector(begin, i16)) & (((i16)1 << __builtin_convertvector(end, i16)) - 1);
    columns = low <= high ? columns << 4 * __builtin_convertvector(line, i16) : (i16)0;
    columns |= __builtin_shufflevector(columns, columns, 1, 0, 3, 2, 5, 4, 7, 6, 9, 8, 11, 10, 13, 12, 15, 14);
    columns |= __builtin_shufflevector(columns, columns, 2, 3, 0, 1, 6, 7, 4, 5, 10, 11, 8, 9, 14, 15, 12, 13);
    if (PATCH_LINES == 8)
        columns |= __builtin_shufflevector(columns, columns, 4, 5, 6, 7, 0, 1, 2, 3, 12, 13, 14, 15, 8, 9, 10, 11);
    for (int g = 0; g < TESTED_AT_ONCE; ++g) reached[g] = (unsigned)columns[PATCH_LINES * g];
};
