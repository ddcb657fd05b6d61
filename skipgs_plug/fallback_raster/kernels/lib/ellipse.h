// The tiles that ellipses at alpha = ALPHA_MIN cross, or a hair more.
//
// Two kernels ask, one to count and one to write where that count made room: they must find the same tiles to the last
// bit. No multiplication and addition are fused here, because Clang may fuse them differently in two places.
#pragma once
#include "record.h"
struct Ellipses {
    v16 mx, my, half_h;  // centres and half heights of their boxes, pixels
    v16 slope, extreme;  // dx / dy of the line of the outermost points in a row; dy of the outermost of all
    v16 inverse_h, chord;

    // Of the ellipses of 16 records.
    explicit Ellipses(const Records16& r)
        : mx(r.x), my(r.y), half_h(r.half_height), slope(r.row_slope), extreme(r.column_slope * r.half_width),
          inverse_h(1.0f / r.half_height), chord(vsqrt(vmax(r.reach, (v16)0.0f)) / r.along) {}
    // 16 times that of one.
    explicit Ellipses(const Record& r)
        : mx(r.x), my(r.y), half_h(r.half_height), slope(r.row_slope), extreme((v16)r.column_slope * (v16)r.half_width),
          inverse_h(1.0f / (v16)r.half_height), chord(vsqrt(vmax((v16)r.reach, (v16)0.0f)) / (v16)r.along) {}

    // x of the edges on one side (-1 left, 1 right), `dy` below the centres:
    // x(dy) = mx + dy slope +- chord sqrt(1 - (dy / half_h)^2), farthest out at dy = -+extreme.
    v16 edge(v16 dy, float side) const {
#pragma clang fp contract(off)
        const v16 t = dy * inverse_h;
        return mx + dy * slope + side * chord * vsqrt(vmax(1.0f - t * t, (v16)0.0f));
    }

    // Columns [left, right] of tiles in which the part in row `ty` of tiles lies, which is convex.
    void columns(i16 ty, float width, i16& left, i16& right) const {
#pragma clang fp contract(off)
        const v16 top = 16.0f * __builtin_convertvector(ty, v16) + 0.5f - my;
        const v16 low = vmax(top, -half_h), high = vmin(top + 15.0f, half_h);
        const v16 x0 = edge(vmin(vmax(-extreme, low), high), -1.0f) - 0.51f;
        const v16 x1 = edge(vmin(vmax(extreme, low), high), 1.0f) - 0.49f;
        static_assert(TILE == 16, "pixels to tiles");
        // What lies beside the image is beyond the last column, of which the image may hold a part only.
        left = clamped(__builtin_elementwise_ceil(x0), 0.0f, width + 15.0f) >> 4;
        right = clamped(__builtin_elementwise_floor(x1), -1.0f, width - 1.0f) >> 4;
    }
};

// The box of tiles around a large ellipse.
struct TileBox {
    int first_column, last_column, first_row, last_row;
};
static_assert(sizeof(TileBox) == sizeof(int) * BOX_INTS, "constants.BOX_INTS");

// Tells `take` the tiles of a box that the ellipse of record `r` crosses, row by row, or all of them.
static constexpr auto each_tile = [](const Record& r, const TileBox& box, float width, int tiles_x, bool all,
                                     auto take) INLINE {
    const Ellipses ellipse(r);
    for (int row = box.first_row; row <= box.last_row; row += 16) {
        i16 left, right;
        ellipse.columns(row + __builtin_convertvector(lane, i16), width, left, right);
        alignas(64) int from[16], to[16];
        *(i16*)from = all ? (i16)box.first_column : vmax(left, (i16)box.first_column);
        *(i16*)to = all ? (i16)box.last_column : vmin(right, (i16)box.last_column);
        for (int l = 0; l < 16 && row + l <= box.last_row; ++l)
            for (int column = from[l]; column <= to[l]; ++column) take((row + l) * tiles_x + column);
    }
};
