// One tile of 4 x 4 blocks of 4 x 4 pixels; a block is one value.
struct Tile {
    int x0, y0, rows, columns;  // of its pixels that lie in the image
    int begin, end;             // its part of the list
    v16 px[4], py[4];           // centres of the pixels of each column and row of blocks

    Tile(int t, const int* tile_start, int tiles_x, int width, int height)
        : x0(t % tiles_x * TILE), y0(t / tiles_x * TILE), rows(smaller(TILE, height - y0)),
          columns(smaller(TILE, width - x0)), begin(tile_start[t]), end(tile_start[t + 1]) {
        for (int i = 0; i < 4; ++i) {
            px[i] = lane_x + (x0 + 4 * i + 0.5f);
            py[i] = lane_y + (y0 + 4 * i + 0.5f);
        }
    }
};

// How much of the Gaussian of record `r` each pixel of a block sees.
struct Falloff {
    v16 dx, dy, p, w, log2_alpha;  // alpha = exp2(r[5] - p^2 - w^2)

    Falloff(const Tile& tile, int block, const float* r) {
#pragma clang fp contract(fast)
        dx = tile.px[block & 3] - r[0], dy = tile.py[block >> 2] - r[1];
        p = r[2] * dx + r[3] * dy, w = r[4] * dy;
        log2_alpha = r[5] - w * w - p * p;  // p takes longest
    }
};
