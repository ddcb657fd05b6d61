// Pixels on their way between images, where they lie in rows, and patches: 4 x 4 at a time, one patch or two of which one
// lies below the other. Whole quads move by vectors; pixel by pixel that took a sixth of a blend.
#pragma once
#include "blend_tile.h"
static constexpr int QUADS = 16;  // of a tile

struct Quad {
    int patch;          // the first
    int rows, columns;  // of its pixels that lie in the image
    int width;          // of the image
    long long first;    // its first pixel

    Quad(const Tile& tile, int q, int width)
        : patch(q / 4 * (LINES / 4) * 4 + q % 4), rows(larger(0, smaller(4, tile.rows - q / 4 * 4))),
          columns(larger(0, smaller(4, tile.columns - q % 4 * 4))), width(width),
          first((long long)(tile.y0 + q / 4 * 4) * width + tile.x0 + q % 4 * 4) {}
    bool whole() const { return rows == 4 && columns == 4; }
    bool inside(int l) const { return l % 4 < columns && l / 4 < rows; }
    long long pixel(int l) const { return first + (long long)(l / 4) * width + l % 4; }
};
// `patches` are `step` values apart.
#ifdef __AVX512F__
static constexpr auto set_patches = [](vpatch* patches, const Quad& quad, int step, v16 a) INLINE {
    patches[quad.patch * step] = a;
};
static constexpr auto of_patches = [](const vpatch* patches, const Quad& quad, int step) INLINE -> v16 {
    return patches[quad.patch * step];
};
#else
static constexpr auto set_patches = [](vpatch* patches, const Quad& quad, int step, v16 a) INLINE {
    patches[quad.patch * step] = a.lo;
    patches[(quad.patch + 4) * step] = a.hi;
};
static constexpr auto of_patches = [](const vpatch* patches, const Quad& quad, int step) INLINE -> v16 {
    return __builtin_shufflevector(patches[quad.patch * step], patches[(quad.patch + 4) * step], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9,
                                   10, 11, 12, 13, 14, 15);
};
#endif

// Four numbers of each row of a quad, `stride` a pixel, from number `c` on.
static constexpr auto read_rows = [](const float* image, const Quad& quad, int stride, int c) INLINE -> v16 {
    v4 r[4];
    for (int y = 0; y < 4; ++y) r[y] = *(const v4*)(image + quad.pixel(4 * y) * stride + c);
    return join(r);
};
static constexpr auto write_rows = [](float* image, const Quad& quad, int stride, int c, v16 a) INLINE {
    v4 r[4] = {a.lo.lo, a.lo.hi, a.hi.lo, a.hi.hi};
    for (int y = 0; y < 4; ++y) *(v4*)(image + quad.pixel(4 * y) * stride + c) = r[y];
};
// `channels` of `stride`, from the first of `image` on, and `count` values of each patch, 1, 3 or 4: more than there are
// channels become 0, as all do outside the image.
static constexpr auto read_patches = [](const float* image, const Quad& quad, int stride, int channels, vpatch* patches,
                                       int count) INLINE {
    v16 columns[4];
    if (quad.whole() && count == stride && count == channels) {
        v16 a[4];
        for (int i = 0; i < count; ++i) a[i] = read_rows(image, quad, stride, 4 * i);
        if (count == 1) columns[0] = a[0];
        if (count == 3) {
            columns[0] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 0, 3, 6, 6), a[2], 0, 1, 2, 5);
            columns[1] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 1, 4, 7, 7), a[2], 0, 1, 2, 6);
            columns[2] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 2, 5, 5, 5), a[2], 0, 1, 4, 7);
        }
        if (count == 4) transpose_quarters(a, columns);
    } else
        for (int c = 0; c < count; ++c) {
            columns[c] = (v16)0.0f;
            for (int l = 0; l < 16; ++l)
                if (c < channels && quad.inside(l)) columns[c][l] = image[quad.pixel(l) * stride + c];
        }
    for (int c = 0; c < count; ++c) set_patches(patches + c, quad, count, columns[c]);
};
static constexpr auto write_patches = [](float* image, const Quad& quad, int stride, int channels, const vpatch* patches,
                                        int count) INLINE {
    v16 columns[4];
    for (int c = 0; c < count; ++c) columns[c] = of_patches(patches + c, quad, count);
    if (quad.whole() && count == stride && count == channels) {
        v16 a[4];
        if (count == 1) a[0] = columns[0];
        if (count == 3) {
            a[0] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 0, 4, 4, 1), columns[2], 0, 1, 4, 3);
            a[1] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 5, 5, 2, 6), columns[2], 0, 5, 2, 3);
            a[2] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 3, 3, 7, 7), columns[2], 6, 0, 2, 7);
        }
        if (count == 4) transpose_quarters(columns, a);
        for (int i = 0; i < count; ++i) write_rows(image, quad, stride, 4 * i, a[i]);
    } else
        for (int c = 0; c < count; ++c)
            for (int l = 0; l < 16; ++l)
                if (c < channels && quad.inside(l)) image[quad.pixel(l) * stride + c] = columns[c][l];
};
