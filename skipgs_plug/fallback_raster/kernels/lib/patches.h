// Moves pixels between images, where they lie in rows, and patches. It moves a quad at a time: 4 x 4 pixels, which are
// one patch or two patches one above the other. Whole quads move as vectors: pixel by pixel took a sixth of a blend's
// time.
#pragma once
#include "blend_tile.h"
static constexpr int TILE_QUADS = 16;  // quads of 4 x 4 pixels in a tile of 16 x 16

struct Quad {
    int patch;          // number of its first patch
    int rows, columns;  // that lie in the image
    int width;          // of the image, pixels
    long long first;    // index of its first pixel in the image

    Quad(const Tile& tile, int q, int width)
        : patch(q / 4 * (PATCH_LINES / 4) * 4 + q % 4), rows(larger(0, smaller(4, tile.rows - q / 4 * 4))),
          columns(larger(0, smaller(4, tile.columns - q % 4 * 4))), width(width),
          first((long long)(tile.y0 + q / 4 * 4) * width + tile.x0 + q % 4 * 4) {}
    bool whole() const { return rows == 4 && columns == 4; }
    bool inside(int l) const { return l % 4 < columns && l / 4 < rows; }
    long long pixel(int l) const { return first + (long long)(l / 4) * width + l % 4; }
};
// Writes and reads the patches of a quad. Consecutive patches are `step` vectors apart.
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

// Four floats of each row of a quad, from float `c` of its first pixel on. A pixel has `stride` floats.
static constexpr auto read_rows = [](const float* image, const Quad& quad, int stride, int c) INLINE -> v16 {
    v4 r[4];
    for (int y = 0; y < 4; ++y) r[y] = *(const v4*)(image + quad.pixel(4 * y) * stride + c);
    return join(r);
};
static constexpr auto write_rows = [](float* image, const Quad& quad, int stride, int c, v16 a) INLINE {
    v4 r[4] = {a.lo.lo, a.lo.hi, a.hi.lo, a.hi.hi};
    for (int y = 0; y < 4; ++y) *(v4*)(image + quad.pixel(4 * y) * stride + c) = r[y];
};
// Reads `channels` of the `stride` channels of each pixel, from the first of `image` on, to `count` vectors of each
// patch. `count` is 1, 3 or 4. Channels beyond `channels` and pixels outside the image become 0.
static constexpr auto read_patches = [](const float* image, const Quad& quad, int stride, int channels, vpatch* patches,
                                       int count) INLINE {
    v16 columns[4];
    if (quad.whole() && count == stride && count == channels) {
        v16 a[4];
        for (int i = 0; i < count; ++i) a[i] = read_rows(image, quad, stride, 4 * i);
        if (count == 1) columns[0] = a[0];
        if (count == 3) {
            columns[0] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(a[0], a[1], 0, 3, 6, 6), a[2], 0, 1, 2, 5);
            columns[1] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(a[0], a[1], 1, 4, 7, 7), a[2], 0, 1, 2, 6);
            columns[2] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(a[0], a[1], 2, 5, 5, 5), a[2], 0, 1, 4, 7);
        }
        if (count == 4) transpose_4x4(a, columns);
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
            a[0] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(columns[0], columns[1], 0, 4, 4, 1), columns[2], 0, 1, 4, 3);
            a[1] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(columns[0], columns[1], 5, 5, 2, 6), columns[2], 0, 5, 2, 3);
            a[2] = SHUFFLE_WITHIN_QUARTERS(SHUFFLE_WITHIN_QUARTERS(columns[0], columns[1], 3, 3, 7, 7), columns[2], 6, 0, 2, 7);
        }
        if (count == 4) transpose_4x4(columns, a);
        for (int i = 0; i < count; ++i) write_rows(image, quad, stride, 4 * i, a[i]);
    } else
        for (int c = 0; c < count; ++c)
            for (int l = 0; l < 16; ++l)
                if (c < channels && quad.inside(l)) image[quad.pixel(l) * stride + c] = columns[c][l];
};
