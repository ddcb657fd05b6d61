// How deep the lists of each tile go at first: as far as a sample of the rows says that its pixels are filled, and more.
//
// What a Gaussian takes of the light of all pixels, the volume 2 pi opacity sqrt(det) under it, is added up by cells of
// tiles and by depth. A tile that this leaves open goes on later, so any depth gives the same image.
//
// Reads the projected splats. Writes `taken`, `ranges` and `share`, alone.
#pragma once
#include "lib/simd.h"
static constexpr auto near_ranges = [](const int* visible, const Splats& splats, float* taken, int* ranges, float* share,
                                       const Grid& grid, int m, int n, int first, int last) INLINE {
    constexpr float TAU = 6.2831853f;
    const int tiles_x = grid.tiles_x, tiles_y = grid.tiles_y;
    const float width = grid.width, height = grid.height;
    const int columns = (tiles_x + CELL - 1) / CELL, rows = (tiles_y + CELL - 1) / CELL;
    const int stride = larger(1, m / SAMPLES);
    const float *const conics = splats.conics, *const means2d = splats.means2d;
    const int* const depths = (const int*)splats.depths;  // as bits
    const auto volume = [&](int g) INLINE -> float {
        const float det = conics[3 * g] * conics[3 * g + 2] - conics[3 * g + 1] * conics[3 * g + 1];
        // No more than one of its opacity over a whole cell.
        return fminf(TAU / __builtin_sqrtf(fmaxf(det, 1e-12f)), (float)TILE * TILE * CELL * CELL) * splats.opacities[g];
    };
    // A few rows tell whether there is anything to be gained.
    float total = 0.0f;
    for (int i = 0; i < m; i += 16 * stride) total += volume(visible[i]);
    if (total * 16 * stride < 1.5f * ENOUGH * width * height) {
        share[0] = 1.0f;
        return;
    }
    int least = 0x7fffffff, most = 0;
    for (int i = 0; i < m; i += stride) {
        const int depth = depths[visible[i]];
        least = smaller(least, depth), most = larger(most, depth);
    }
    least = larger(least, 0);
    const float scale = LAYERS / ((float)most - (float)least + 1.0f);
    const auto layer = [&](int depth) { return larger(0, smaller(LAYERS - 1, (int)(((float)depth - (float)least) * scale))); };
    clear(taken, (long long)columns * rows * LAYERS);
    for (int i = 0; i < m; i += stride) {
        const int g = visible[i];
        const int x = smaller(columns - 1, (int)(fminf(fmaxf(means2d[2 * g], 0.0f), width) / (TILE * CELL)));
        const int y = smaller(rows - 1, (int)(fminf(fmaxf(means2d[2 * g + 1], 0.0f), height) / (TILE * CELL)));
        taken[(y * columns + x) * LAYERS + layer(depths[g])] += volume(g);
    }
    // The first depth that is left out, by cell.
    for (int cell = 0; cell < columns * rows; ++cell) {
        const int x = cell % columns * CELL * TILE, y = cell / columns * CELL * TILE;
        const float pixels = (fminf(x + CELL * TILE, width) - x) * (fminf(y + CELL * TILE, height) - y);
        float sum = 0.0f, *of_cell = taken + cell * LAYERS;
        int l = 0;
        while (l < LAYERS && sum * stride < ENOUGH * pixels) sum += of_cell[l++];
        of_cell[0] = (float)l;
    }
    for (int t = 0; t < tiles_x * tiles_y; ++t) {
        const int l = (int)taken[(t / tiles_x / CELL * columns + t % tiles_x / CELL) * LAYERS];
        ranges[2 * t] = -0x7fffffff;
        ranges[2 * t + 1] = l < LAYERS ? least + (int)((float)l / scale) : 0x7fffffff;
    }
    int listed = 0, all = 0;
    for (int i = 0; i < m; i += stride, ++all) {
        const int g = visible[i];
        const int x = smaller(tiles_x - 1, (int)(fminf(fmaxf(means2d[2 * g], 0.0f), width) / TILE));
        const int y = smaller(tiles_y - 1, (int)(fminf(fmaxf(means2d[2 * g + 1], 0.0f), height) / TILE));
        listed += depths[g] < ranges[2 * (y * tiles_x + x) + 1];
    }
    share[0] = all ? (float)listed / all : 1.0f;
};
