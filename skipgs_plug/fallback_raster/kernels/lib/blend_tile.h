// One tile in patches of pixels; a patch is one value. The blends hold a dozen of them at a time, so a patch is as large
// as a register where registers are few: 4 x 4 pixels with AVX-512, which has 32, and 4 x 2 elsewhere.
#pragma once
#include "record.h"
#include "simd.h"
#ifdef __AVX512F__
typedef v16 vpatch;
typedef i16 ipatch;
static constexpr int ROWS = 4;  // of pixels in a patch
static constexpr vpatch lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vpatch lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f, 2.f, 2.f, 2.f, 2.f, 3.f, 3.f, 3.f, 3.f};
#else
typedef v8 vpatch;
typedef i8 ipatch;
static constexpr int ROWS = 2;
static constexpr vpatch lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vpatch lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f};
#endif
// Lines of four patches in a tile; at most 32 patches, one for each bit of an int.
static constexpr int LINES = TILE / ROWS, PATCHES = 4 * LINES;

struct Tile {
    int x0, y0, rows, columns;  // of its pixels that lie in the image
    int begin, end;             // its part of the list
    vpatch px[4], py[LINES];    // centres of the pixels of each column and line of patches

    Tile(int t, const int* tile_start, const Grid& grid)
        : x0(t % grid.tiles_x * TILE), y0(t / grid.tiles_x * TILE), rows(smaller(TILE, grid.height - y0)),
          columns(smaller(TILE, grid.width - x0)), begin(tile_start[t]), end(tile_start[t + 1]) {
        for (int i = 0; i < 4; ++i) px[i] = lane_x + (x0 + 4 * i + 0.5f);
        for (int i = 0; i < LINES; ++i) py[i] = lane_y + (y0 + ROWS * i + 0.5f);
    }

    // The pixels of a patch that lie in the image.
    ipatch inside(int b) const {
        return (lane_x + 4 * (b & 3) < (float)columns) & (lane_y + ROWS * (b >> 2) < (float)rows);
    }
};

// How much of a Gaussian each pixel of a patch sees.
struct Falloff {
    vpatch dx, dy, p, w, log2_alpha;  // alpha = exp2(log2_opacity - p^2 - w^2)

    Falloff(const Tile& tile, int patch, const Record& r) {
#pragma clang fp contract(fast)
        dx = tile.px[patch & 3] - r.x, dy = tile.py[patch >> 2] - r.y;
        // Rounded by itself. Clang would fuse p's sum with one of its products, here with this one and there with the
        // other, and what the adjoint sees has to be what was blended.
        vpatch slanted;
        {
#pragma clang fp contract(off)
            slanted = r.slant * dy;
        }
        p = r.along * dx + slanted, w = r.across * dy;
        log2_alpha = r.log2_opacity - w * w - p * p;  // p takes longest
    }
};
