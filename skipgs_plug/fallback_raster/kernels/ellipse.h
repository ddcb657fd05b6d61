// The ellipse at alpha = ALPHA_MIN of one Gaussian, and the tiles that it crosses.
//
// Two kernels ask, one to count and one to write where that count made room: they must find the same tiles to the last
// bit. No multiplication and addition are fused here, because Clang may fuse them differently in two places.
struct Ellipse {
    float mx, my, half_w, half_h;  // centre and half axes of its box, pixels
    float slope, extreme;          // dx / dy of the line of its outermost points in a row; dy of the outermost of all
    float inverse_h, chord;
    float width;
    int box_left, box_right;  // columns of pixels whose centres the box holds
    int first_row, last_row;  // rows of tiles
    bool whole;               // take every tile of the box

    // `r` is its record, see `constants.RECORD`; not `exact`, it crosses every tile of its box.
    Ellipse(const float* r, float width, float height, bool exact)
        : mx(r[0]), my(r[1]), half_w(r[7]), half_h(r[6]), slope(r[12]), extreme(r[13] * r[7]), width(width) {
#pragma clang fp contract(off)
        // Clamped before they become integers: what lies far outside is beyond their range.
        const int top = (int)ceilf(fminf(fmaxf(my - half_h - 0.5f, 0.0f), height));
        const int bottom = (int)floorf(fmaxf(fminf(my + half_h - 0.5f, height - 1.0f), -1.0f));
        box_left = (int)ceilf(fminf(fmaxf(mx - half_w - 0.5f, 0.0f), width));
        box_right = (int)floorf(fmaxf(fminf(mx + half_w - 0.5f, width - 1.0f), -1.0f));
        const bool empty = top > bottom || box_left > box_right;
        first_row = top / TILE, last_row = empty ? first_row - 1 : bottom / TILE;
        // Small ones need no more than their bounding box.
        whole = box_left / TILE == box_right / TILE || first_row == last_row || !exact;
        inverse_h = whole ? 0.0f : 1.0f / half_h;
        chord = whole ? 0.0f : sqrtf(fmaxf(r[14], 0.0f)) / r[2];
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
        left = box_left / TILE;
        right = box_right / TILE;
        if (whole) return;
        const float low = fmaxf(TILE * (float)ty + 0.5f - my, -half_h);
        const float high = fminf(TILE * (float)ty + (TILE - 0.5f) - my, half_h);
        const float x0 = edge(fminf(fmaxf(-extreme, low), high), -1.0f) - 0.51f;
        const float x1 = edge(fminf(fmaxf(extreme, low), high), 1.0f) - 0.49f;
        left = larger(left, (int)fminf(fmaxf(ceilf(x0), 0.0f), width) / TILE);
        right = smaller(right, x1 < 0.0f ? -1 : (int)floorf(fminf(x1, width - 1.0f)) / TILE);
    }
};
