// Tiles of BAND rows by CHUNK vectors of a channels-last image, as both passes of the loss see them.
static constexpr float w[WINDOW] = {0.00102838f, 0.00759876f, 0.03600077f, 0.10936069f, 0.21300554f, 0.26601172f,
                                    0.21300554f, 0.10936069f, 0.03600077f, 0.00759876f, 0.00102838f};
static constexpr int RADIUS = WINDOW / 2;

struct Rows {
    int span, vectors, reach;  // floats and vectors of a row, floats from the middle of the window to its ends
    int margin;                // room that a row of slopes has for the window on either side
    int bands, chunks;         // tiles of an image

    Rows(int height, int width, int channels)
        : span(width * channels), vectors((span + 15) / 16), reach(RADIUS * channels), margin((reach + 15) / 16 * 16),
          bands((height + BAND - 1) / BAND), chunks((vectors + CHUNK - 1) / CHUNK) {}
};

struct LossTile {
    int top, bottom, first_vector, last_vector;
    long long start;  // first row of its image
    const float *x, *y, *offset;
    int span;

    LossTile(const Rows& rows, int item, int height, const float* image, const float* target, const float* offsets)
        : top(item / rows.chunks % rows.bands * BAND), bottom(smaller(top + BAND, height)),
          first_vector(item % rows.chunks * CHUNK), last_vector(smaller(first_vector + CHUNK, rows.vectors)),
          start((long long)(item / rows.chunks / rows.bands) * height), x(image + start * rows.span),
          y(target + start * rows.span),
          offset(offsets + (long long)(item / rows.chunks / rows.bands) * 16 * rows.vectors), span(rows.span) {}

    // Floats `i` to `i + 15` of a row that may end before.
    v16 piece(const float* row, int i) const {
        if (i + 16 <= span) return load(row + i);
        v16 a = (v16)0.0f;
        for (int j = 0; i + j < span; ++j) a[j] = row[i + j];
        return a;
    }
};
