// Pixels on their way between images, where they lie in rows, and blocks: 4 x 4 at a time, one block or two of which one lies
// below the other. Whole quads move by vectors; pixel by pixel that took a sixth of a blend.
static constexpr int QUADS = 16;  // of a tile

struct Quad {
    int block;          // the first
    int rows, columns;  // of its pixels that lie in the image
    int width;          // of the image
    long long first;    // its first pixel

    Quad(const Tile& tile, int q, int width)
        : block(q / 4 * (LINES / 4) * 4 + q % 4), rows(larger(0, smaller(4, tile.rows - q / 4 * 4))),
          columns(larger(0, smaller(4, tile.columns - q % 4 * 4))), width(width),
          first((long long)(tile.y0 + q / 4 * 4) * width + tile.x0 + q % 4 * 4) {}
    bool whole() const { return rows == 4 && columns == 4; }
    bool inside(int l) const { return l % 4 < columns && l / 4 < rows; }
    long long pixel(int l) const { return first + (long long)(l / 4) * width + l % 4; }
};
// `blocks` are `step` values apart.
#ifdef __AVX512F__
static constexpr auto set_blocks = [](vblock* blocks, const Quad& quad, int step, v16 a) INLINE {
    blocks[quad.block * step] = a;
};
static constexpr auto of_blocks = [](const vblock* blocks, const Quad& quad, int step) INLINE -> v16 {
    return blocks[quad.block * step];
};
#else
static constexpr auto set_blocks = [](vblock* blocks, const Quad& quad, int step, v16 a) INLINE {
    blocks[quad.block * step] = a.lo;
    blocks[(quad.block + 4) * step] = a.hi;
};
static constexpr auto of_blocks = [](const vblock* blocks, const Quad& quad, int step) INLINE -> v16 {
    return __builtin_shufflevector(blocks[quad.block * step], blocks[(quad.block + 4) * step], 0, 1, 2, 3, 4, 5, 6, 7, 8, 9,
                                   10, 11, 12, 13, 14, 15);
};
#endif

// Four numbers of each row of a quad, `stride` a pixel, from number `c` on.
static constexpr auto read_rows = [](const float* image, const Quad& quad, int stride, int c) INLINE -> v16 {
    v4 r[4];
    for (int y = 0; y < 4; ++y) r[y] = *(const v4*)(image + quad.pixel(4 * y) * stride + c);
    const auto low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
    const auto high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
};
static constexpr auto write_rows = [](float* image, const Quad& quad, int stride, int c, v16 a) INLINE {
    v4 r[4] = {a.lo.lo, a.lo.hi, a.hi.lo, a.hi.hi};
    for (int y = 0; y < 4; ++y) *(v4*)(image + quad.pixel(4 * y) * stride + c) = r[y];
};
// One number a pixel, 0 outside the image.
static constexpr auto read_pixels = [](const float* image, const Quad& quad) INLINE -> v16 {
    if (quad.whole()) return read_rows(image, quad, 1, 0);
    v16 a = (v16)0.0f;
    for (int l = 0; l < 16; ++l)
        if (quad.inside(l)) a[l] = image[quad.pixel(l)];
    return a;
};
static constexpr auto write_pixels = [](float* image, const Quad& quad, v16 a) INLINE {
    if (quad.whole()) return write_rows(image, quad, 1, 0, a);
    for (int l = 0; l < 16; ++l)
        if (quad.inside(l)) image[quad.pixel(l)] = a[l];
};
// Numbers of each quarter of `a` (0 to 3) and of `b` (4 to 7).
#define QUARTER(q, i) (i) + 4 * (q) + ((i) < 4 ? 0 : 12)
#define QUARTERS(q, i, j, k, l) QUARTER(q, i), QUARTER(q, j), QUARTER(q, k), QUARTER(q, l)
#define SHUFFLE_QUARTERS(a, b, ...) \
    __builtin_shufflevector(a, b, QUARTERS(0, __VA_ARGS__), QUARTERS(1, __VA_ARGS__), QUARTERS(2, __VA_ARGS__), \
                            QUARTERS(3, __VA_ARGS__))
// `channels` of `stride`, from the first of `image` on, as columns; more of these `count` become 0, as all do outside the
// image.
static constexpr auto read_channels = [](const float* image, const Quad& quad, int stride, int channels, v16* columns,
                                         int count) INLINE {
    if (quad.whole() && count == stride && count == channels) {
        v16 a[4];
        for (int i = 0; i < count; ++i) a[i] = read_rows(image, quad, stride, 4 * i);
        if (count == 1) columns[0] = a[0];
        if (count == 3) {
            columns[0] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 0, 3, 6, 6), a[2], 0, 1, 2, 5);
            columns[1] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 1, 4, 7, 7), a[2], 0, 1, 2, 6);
            columns[2] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(a[0], a[1], 2, 5, 5, 5), a[2], 0, 1, 4, 7);
        }
        if (count == 4) quarters(a, columns);
        return;
    }
    for (int c = 0; c < count; ++c) {
        columns[c] = (v16)0.0f;
        for (int l = 0; l < 16; ++l)
            if (c < channels && quad.inside(l)) columns[c][l] = image[quad.pixel(l) * stride + c];
    }
};
static constexpr auto write_channels = [](float* image, const Quad& quad, int stride, int channels, const v16* columns,
                                          int count) INLINE {
    if (quad.whole() && count == stride && count == channels) {
        v16 a[4];
        if (count == 1) a[0] = columns[0];
        if (count == 3) {
            a[0] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 0, 4, 4, 1), columns[2], 0, 1, 4, 3);
            a[1] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 5, 5, 2, 6), columns[2], 0, 5, 2, 3);
            a[2] = SHUFFLE_QUARTERS(SHUFFLE_QUARTERS(columns[0], columns[1], 3, 3, 7, 7), columns[2], 6, 0, 2, 7);
        }
        if (count == 4) quarters(columns, a);
        for (int i = 0; i < count; ++i) write_rows(image, quad, stride, 4 * i, a[i]);
        return;
    }
    for (int c = 0; c < count; ++c)
        for (int l = 0; l < 16; ++l)
            if (c < channels && quad.inside(l)) image[quad.pixel(l) * stride + c] = columns[c][l];
};
