// A Gaussian as the blend reads it, and what one tile adds to its gradient: a cache line each.
#pragma once
#include "simd.h"

// With p = along dx + slant dy and w = across dy, alpha = exp2(log2_opacity - p^2 - w^2): a sum of squares, so that no
// needle rounds to a negative value. Lengths are pixels, and the ellipse is the one at alpha = ALPHA_MIN.
struct Record {
    float x, y;  // centre
    float along, slant, across, log2_opacity;
    float half_height, half_width;  // of the box around the ellipse
    float color[4];                 // of the channels of one pass
    float row_slope;                // dx / dy of the points where p^2 + w^2 is least in a row of pixels
    float column_slope;             // dy / dx of those in a column
    float reach;                    // p^2 + w^2 at the ellipse
    float inverse_along;            // 1 / along
};
static_assert(sizeof(Record) == sizeof(float) * RECORD, "constants.RECORD");

// The same of 16 Gaussians, to be transposed.
struct Records16 {
    v16 x, y, along, slant, across, log2_opacity, half_height, half_width, color[4];
    v16 row_slope, column_slope, reach, inverse_along;
};
static_assert(sizeof(Records16) == 16 * sizeof(Record), "the fields of a record");

// Sums over the pixels of a tile. v_sigma is the gradient of -ln(alpha); its moments about the Gaussian's centre make the
// gradients of centre and conic.
struct PairSum {
    float moment[6];    // v_sigma times 1, dx, dy, dx^2, dx dy, dy^2
    float color[4];     // of the colour's gradient
    float absolute[2];  // |v_x|, |v_y| of the centre
    float unused[4];
};
static_assert(sizeof(PairSum) == sizeof(float) * PAIR, "constants.PAIR");
