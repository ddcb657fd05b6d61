// The tiles that the ellipse at alpha = ALPHA_MIN of one Gaussian crosses.
//
// Two kernels ask, one to count and one to write where that count made room: they must find the same tiles to the last
// bit. No multiplication and addition are fused here, because Clang may fuse them differently in two places.
struct Ellipse {
    float mx, my, half_h;          // centre and half height of its box, pixels
    float slope, extreme;          // dx / dy of the line of its outermost points in a row; dy of the outermost of all
    float inverse_h, chord;
    float width;
    int box_left, box_right;  // columns of tiles that its box crosses
    int first_row, last_row;  // rows of tiles
    bool whole;               // take every tile of the box

    // `r` is its record, see `constants.RECORD`, and `box` the tiles of its box: left, right, first and last row. Not
    // `exact`, it crosses every tile of its box.
    Ellipse(const float* r, const int* box, float width, bool exact)
        : width(width), box_left(box[0]), box_right(box[1]), first_row(box[2]), last_row(box[3]) {
#pragma clang fp contract(off)
        // Small ones need no more than their bounding box.
        whole = box_left == box_right || first_row >= last_row || !exact;
        if (whole) return;
        mx = r[0], my = r[1], half_h = r[6], slope = r[12], extreme = r[13] * r[7];
        inverse_h = 1.0f / half_h;
        chord = sqrtf(fmaxf(r[14], 0.0f)) / r[2];
    }

    // x of its edge on one side (-1 left, 1 right), `dy` below its centre:
    // x(dy) = mx + dy slope +- chord sqrt(1 - (dy / half_h)^2), farthest out at dy = -+extreme.
    float edge(float dy, float side) const {
#pragma clang fp contract(off)
        const float t = dy * inverse_h;
        return mx + dy * slope + side * chord * sqrtf(fmaxf(1.0f - t * t, 0.0f));
    }

    // Tiles [left, right] of tile row `ty`.
    void columns(int ty, int& left, int& right) const {
#pragma clang fp contract(off)
        left = box_left;
        right = box_right;
        if (whole) return;
        const float low = fmaxf(TILE * (float)ty + 0.5f - my, -half_h);
        const float high = fminf(TILE * (float)ty + (TILE - 0.5f) - my, half_h);
        const float x0 = edge(fminf(fmaxf(-extreme, low), high), -1.0f) - 0.51f;
        const float x1 = edge(fminf(fmaxf(extreme, low), high), 1.0f) - 0.49f;
        left = larger(left, (int)fminf(fmaxf(ceilf(x0), 0.0f), width) / TILE);
        right = smaller(right, x1 < 0.0f ? -1 : (int)floorf(fminf(x1, width - 1.0f)) / TILE);
    }
};
