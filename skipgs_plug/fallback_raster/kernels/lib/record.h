// The record of a Gaussian, which the blend reads, and the sums that one tile adds to its gradient. Each fills a cache
// line.
#pragma once
#include "simd.h"

// With p = along dx + slant dy and w = across dy, alpha = exp2(log2_opacity - p^2 - w^2). A sum of squares cannot round
// to a negative value, however thin the needle. Lengths are in pixels. `The ellipse` is the contour alpha = ALPHA_MIN.
struct Record {
    float x, y;  // centre
    float along, slant, across, log2_opacity;
    float half_height, half_width;  // of the box around the ellipse
    float color[MAX_CHANNELS];      // channels of one pass
    float row_slope;                // dx / dy of the points with the largest alpha in each row of pixels
    float column_slope;             // dy / dx of the points with the largest alpha in each column
    float reach;                    // p^2 + w^2 on the ellipse
    float inverse_along;            // 1 / along
};
static_assert(sizeof(Record) == sizeof(float) * RECORD_FLOATS, "constants.RECORD_FLOATS");

// Records of 16 Gaussians by field. Transposed, they are 16 records.
struct Records16 {
    v16 x, y, along, slant, across, log2_opacity, half_height, half_width, color[MAX_CHANNELS];
    v16 row_slope, column_slope, reach, inverse_along;
};
static_assert(sizeof(Records16) == 16 * sizeof(Record), "the fields of a record");

// Moments about the mean: sums of v_sigma times 1, dx, dy, dx^2, dx dy and dy^2. v_sigma is the gradient of the loss by
// sigma = -ln(alpha / opacity). The gradients of the 2D mean and the conic follow from its moments.
enum Moment { OF_1, OF_X, OF_Y, OF_XX, OF_XY, OF_YY, MOMENTS };

// Sums over the pixels of a tile.
struct PairSum {
    float moment[MOMENTS];
    float color[MAX_CHANNELS];  // gradient of the colour
    float absolute[2];          // |v_x|, |v_y| of the 2D mean
    float unused[4];
};
static_assert(sizeof(PairSum) == sizeof(float) * PAIR_FLOATS, "constants.PAIR_FLOATS");
