// Chooses how deep the first lists of each tile go, from a sample of the rows.
//
// The volume under a splat, 2 pi opacity sqrt(det cov2d), says how much light it takes from all pixels together. The
// kernel adds up the volumes by cell and depth layer, and ends a cell's lists where they cover the cell
// NEAR_OPTICAL_DEPTH times. Tiles that are still open there are continued in a second pass, so every choice gives the
// same image.
//
// Reads the projected splats. Writes `taken`, `ranges` and `share`. It runs on one thread.
#pragma once
#include "lib/simd.h"
#include "lib/tile_lists.h"
static constexpr auto near_ranges = [](const int* visible, const Splats& splats, float* taken, DepthRange* ranges,
                                       float* share, const Grid& grid, int m, int n, int first, int last) INLINE {
    constexpr float TAU = 6.2831853f;
    const int tiles_x = grid.tiles_x, tiles_y = grid.tiles_y;
    const float width = grid.width, height = grid.height;
    const int columns = (tiles_x + CELL_TILES - 1) / CELL_TILES, rows = (tiles_y + CELL_TILES - 1) / CELL_TILES;
    const int stride = larger(1, m / MIN_SAMPLED_ROWS);
    const int* const depths = (const int*)splats.depths;  // as bits
    const auto volume = [&](int g) INLINE -> float {
        const float *const conic = splats.conics + 3 * g, a = conic[0], b = conic[1], c = conic[2];
        const float det = a * c - b * b;
        // At most its opacity over the area of one cell.
        const float most = (float)TILE * TILE * CELL_TILES * CELL_TILES;
        return fminf(TAU / __builtin_sqrtf(fmaxf(det, 1e-12f)), most) * splats.opacities[g];
    };
    // Column and row, among cells or tiles of `size` pixels, of the one that holds the centre.
    const auto column_of = [&](int g, int size, int columns) INLINE -> int {
        return smaller(columns - 1, (int)(fminf(fmaxf(splats.means2d[2 * g], 0.0f), width) / size));
    };
    const auto row_of = [&](int g, int size, int rows) INLINE -> int {
        return smaller(rows - 1, (int)(fminf(fmaxf(splats.means2d[2 * g + 1], 0.0f), height) / size));
    };
    // One sampled row in 16 is enough to see whether limiting the lists can save anything: the light that all take must
    // be 1.5 times that of lists that end at NEAR_OPTICAL_DEPTH.
    float total = 0.0f;
    for (int i = 0; i < m; i += 16 * stride) total += volume(visible[i]);
    if (total * 16 * stride < 1.5f * NEAR_OPTICAL_DEPTH * width * height) {
        share[0] = 1.0f;
        return;
    }
    int least = NO_DEPTH, most = 0;
    for (int i = 0; i < m; i += stride) {
        const int depth = depths[visible[i]];
        least = smaller(least, depth), most = larger(most, depth);
    }
    least = larger(least, 0);
    const float scale = CELL_LAYERS / ((float)most - (float)least + 1.0f);
    const auto layer = [&](int depth) {
        return larger(0, smaller(CELL_LAYERS - 1, (int)(((float)depth - (float)least) * scale)));
    };
    clear(taken, (long long)columns * rows * CELL_LAYERS);
    for (int i = 0; i < m; i += stride) {
        const int g = visible[i];
        const int x = column_of(g, TILE * CELL_TILES, columns), y = row_of(g, TILE * CELL_TILES, rows);
        taken[(y * columns + x) * CELL_LAYERS + layer(depths[g])] += volume(g);
    }
    // By cell: the first layer that is left out. It is stored in the cell's first layer.
    for (int cell = 0; cell < columns * rows; ++cell) {
        const int x = cell % columns * CELL_TILES * TILE, y = cell / columns * CELL_TILES * TILE;
        const float pixels = (fminf(x + CELL_TILES * TILE, width) - x) * (fminf(y + CELL_TILES * TILE, height) - y);
        float sum = 0.0f, *of_cell = taken + cell * CELL_LAYERS;
        int l = 0;
        while (l < CELL_LAYERS && sum * stride < NEAR_OPTICAL_DEPTH * pixels) sum += of_cell[l++];
        of_cell[0] = (float)l;
    }
    for (int t = 0; t < tiles_x * tiles_y; ++t) {
        const int l = (int)taken[(t / tiles_x / CELL_TILES * columns + t % tiles_x / CELL_TILES) * CELL_LAYERS];
        ranges[t] = {-NO_DEPTH, l < CELL_LAYERS ? least + (int)((float)l / scale) : NO_DEPTH};
    }
    int listed = 0, all = 0;
    for (int i = 0; i < m; i += stride, ++all) {
        const int g = visible[i];
        const int x = column_of(g, TILE, tiles_x), y = row_of(g, TILE, tiles_y);
        listed += depths[g] < ranges[y * tiles_x + x].end;
    }
    share[0] = all ? (float)listed / all : 1.0f;
};
