// A tile divided into patches of pixels, each of which is one vector. The blends keep a dozen patches in registers, so
// a patch is one register wide: 4 x 4 pixels with AVX-512, which has 32 registers, and 4 x 2 pixels elsewhere.
#pragma once
#include "record.h"
#include "simd.h"
#ifdef __AVX512F__
typedef v16 vpatch;
typedef i16 ipatch;
static constexpr int PATCH_ROWS = 4;  // rows of pixels in a patch
static constexpr vpatch lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vpatch lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f, 2.f, 2.f, 2.f, 2.f, 3.f, 3.f, 3.f, 3.f};
#else
typedef v8 vpatch;
typedef i8 ipatch;
static constexpr int PATCH_ROWS = 2;
static constexpr vpatch lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vpatch lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f};
#endif
// Lines of patches in a tile, each of four patches. A tile has at most 32 patches, one for each bit of an unsigned int.
static constexpr int PATCH_LINES = TILE / PATCH_ROWS, PATCHES = 4 * PATCH_LINES;

struct Tile {
    int x0, y0, rows, columns;      // first pixel; rows and columns that lie in the image
    int begin, end;                 // range of the tile in the lists
    vpatch px[4], py[PATCH_LINES];  // pixel centres of each column and each line of patches

    Tile(int t, const int* tile_start, const Grid& grid)
        : x0(t % grid.tiles_x * TILE), y0(t / grid.tiles_x * TILE), rows(smaller(TILE, grid.height - y0)),
          columns(smaller(TILE, grid.width - x0)), begin(tile_start[t]), end(tile_start[t + 1]) {
        for (int i = 0; i < 4; ++i) px[i] = lane_x + (x0 + 4 * i + 0.5f);
        for (int i = 0; i < PATCH_LINES; ++i) py[i] = lane_y + (y0 + PATCH_ROWS * i + 0.5f);
    }

    // Mask of the pixels of a patch that lie in the image.
    ipatch inside(int b) const {
        return (lane_x + 4 * (b & 3) < (float)columns) & (lane_y + PATCH_ROWS * (b >> 2) < (float)rows);
    }
};

// Distance to a Gaussian, and its alpha, for each pixel of a patch.
struct Falloff {
    vpatch dx, dy, p, w, log2_alpha;  // alpha = exp2(log2_opacity - p^2 - w^2)

    Falloff(const Tile& tile, int patch, const Record& r) {
#pragma clang fp contract(fast)
        dx = tile.px[patch & 3] - r.x, dy = tile.py[patch >> 2] - r.y;
        // Rounded before the sum. Clang would fuse one of the two products with the sum, and not the same one in both
        // kernels; but the adjoint must see exactly what was blended.
        vpatch slanted;
        {
#pragma clang fp contract(off)
            slanted = r.slant * dy;
        }
        p = r.along * dx + slanted, w = r.across * dy;
        log2_alpha = r.log2_opacity - w * w - p * p;  // p is ready last
    }
};
