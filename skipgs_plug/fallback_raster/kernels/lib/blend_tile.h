// One tile in blocks of pixels; a block is one value. The blends hold a dozen of them at a time, so a block is as large
// as a register where registers are few: 4 x 4 pixels with AVX-512, which has 32, and 4 x 2 elsewhere.
#ifdef __AVX512F__
typedef v16 vblock;
typedef i16 iblock;
static constexpr int ROWS = 4;
static constexpr vblock lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vblock lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f, 2.f, 2.f, 2.f, 2.f, 3.f, 3.f, 3.f, 3.f};
#else
typedef v8 vblock;
typedef i8 iblock;
static constexpr int ROWS = 2;
static constexpr vblock lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr vblock lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f};
#endif
static constexpr int LINES = TILE / ROWS, BLOCKS = 4 * LINES;  // lines of four blocks; at most 32 blocks, for bits of an int

struct Tile {
    int x0, y0, rows, columns;  // of its pixels that lie in the image
    int begin, end;             // its part of the list
    vblock px[4], py[LINES];    // centres of the pixels of each column and line of blocks

    Tile(int t, const int* tile_start, int tiles_x, int width, int height)
        : x0(t % tiles_x * TILE), y0(t / tiles_x * TILE), rows(smaller(TILE, height - y0)),
          columns(smaller(TILE, width - x0)), begin(tile_start[t]), end(tile_start[t + 1]) {
        for (int i = 0; i < 4; ++i) px[i] = lane_x + (x0 + 4 * i + 0.5f);
        for (int i = 0; i < LINES; ++i) py[i] = lane_y + (y0 + ROWS * i + 0.5f);
    }

    // The pixels of a block that lie in the image.
    iblock inside(int b) const {
        return (lane_x + 4 * (b & 3) < (float)columns) & (lane_y + ROWS * (b >> 2) < (float)rows);
    }
};

// How much of the Gaussian of record `r` each pixel of a block sees.
struct Falloff {
    vblock dx, dy, p, w, log2_alpha;  // alpha = exp2(r[5] - p^2 - w^2)

    Falloff(const Tile& tile, int block, const float* r) {
#pragma clang fp contract(fast)
        dx = tile.px[block & 3] - r[0], dy = tile.py[block >> 2] - r[1];
        // Rounded by itself. Clang would fuse p's sum with one of its products, here with this one and there with the
        // other, and what the adjoint sees has to be what was blended.
        vblock slant;
        {
#pragma clang fp contract(off)
            slant = r[3] * dy;
        }
        p = r[2] * dx + slant, w = r[4] * dy;
        log2_alpha = r[5] - w * w - p * p;  // p takes longest
    }
};
