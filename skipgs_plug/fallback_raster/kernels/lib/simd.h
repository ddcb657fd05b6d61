// Vector types and functions. Every kernel begins with this file.
//
// Warp compiles kernels with a Clang of its own, also on machines without a compiler. That Clang accepts C++ with its
// vector extension. A value of type `v16` holds 16 Gaussians or 16 neighbouring pixels. Arithmetic on it reads like
// scalar code and becomes one AVX-512 instruction, two of AVX2, or four of SSE or NEON. Kernels in Warp's Python
// dialect would not be vectorised across pixels. The blends keep most values in registers and use vectors as wide as a
// register (`vpatch`).
//
// Warp puts the text of a kernel into the body of one function. C++ allows no functions there, so functions are lambdas
// without captures, and each file can still be read by itself. After this file follow the constants of `constants.py`
// and the structs that the kernel takes.
#pragma once

// Lets Clang fuse a * b + c into one instruction, which is faster and rounds once. Warp leaves it off. The pragma
// reaches into lambdas but not into member functions, which repeat it.
#pragma clang fp contract(fast)
// Functions are inlined before Clang optimises. Otherwise moving code between functions changes which products Clang
// fuses.
#define INLINE __attribute__((always_inline))

typedef float v16 __attribute__((ext_vector_type(16), aligned(4)));
typedef int i16 __attribute__((ext_vector_type(16), aligned(4)));
typedef bool b16 __attribute__((ext_vector_type(16)));
typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));
typedef int i8 __attribute__((ext_vector_type(8), aligned(4)));

static constexpr float LOG2_E = 1.44269504f, LN_4 = 1.38629436f;

static constexpr v16 lane = {0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f, 8.f, 9.f, 10.f, 11.f, 12.f, 13.f, 14.f, 15.f};
static constexpr auto fmaxf = [](float a, float b) -> float { return a > b ? a : b; };
static constexpr auto fminf = [](float a, float b) -> float { return a < b ? a : b; };
static constexpr auto larger = [](int a, int b) -> int { return a > b ? a : b; };
static constexpr auto smaller = [](int a, int b) -> int { return a < b ? a : b; };
static constexpr auto any = [](auto mask) -> bool { return __builtin_reduce_or(mask) != 0; };
// Bit l is set where lane l of the mask is.
static constexpr auto bits = [](i16 mask) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask != 0, b16));
};
// One instruction each. If either argument is NaN, the result is the second.
static constexpr auto vmin = [](auto a, decltype(a) b) { return a < b ? a : b; };
static constexpr auto vmax = [](auto a, decltype(a) b) { return a > b ? a : b; };
static constexpr auto vabs = [](auto a) { return __builtin_elementwise_abs(a); };
// Clamps before the conversion to integers, which is undefined for values beyond their range.
static constexpr auto clamped = [](v16 x, float low, float high) INLINE -> i16 {
    return __builtin_convertvector(vmin(vmax(x, (v16)low), (v16)high), i16);
};
// A product that Clang does not fuse with the sum around it.
static constexpr auto rounded_product = [](auto a, auto b) INLINE -> decltype(b) {
#pragma clang fp contract(off)
    return a * b;
};
static constexpr auto vsqrt = [](auto a) { return __builtin_elementwise_sqrt(a); };
// Adds lanes pairwise, so that the order of additions, and with it the result to the bit, is fixed.
static constexpr auto sum = [](auto a) -> float {
    v8 b;
    if constexpr (sizeof(a) == sizeof(v8)) b = a;
    else b = a.lo + a.hi;
    auto c = b.lo + b.hi;
    auto d = c.lo + c.hi;
    return d.x + d.y;
};
// A quarter is four neighbouring floats of a v16: 128 bits. SHUFFLE_WITHIN_QUARTERS makes each quarter of its result of
// four floats of the same quarter of `a` (0 to 3) and `b` (4 to 7). The other two macros give the indices of these floats
// for the compiler, to which `b` begins at 16.
#define INDEX_IN_QUARTER(q, i) (i) + 4 * (q) + ((i) < 4 ? 0 : 12)
#define INDICES_IN_QUARTER(q, i, j, k, l) \
    INDEX_IN_QUARTER(q, i), INDEX_IN_QUARTER(q, j), INDEX_IN_QUARTER(q, k), INDEX_IN_QUARTER(q, l)
#define SHUFFLE_WITHIN_QUARTERS(a, b, ...) \
    __builtin_shufflevector(a, b, INDICES_IN_QUARTER(0, __VA_ARGS__), INDICES_IN_QUARTER(1, __VA_ARGS__), \
                            INDICES_IN_QUARTER(2, __VA_ARGS__), INDICES_IN_QUARTER(3, __VA_ARGS__))
// Eight calls of `sum` folded together, with a third of the instructions: first within quarters, until each holds parts
// of four sums, then across quarters.
static constexpr auto sum8 = [](const auto* a) INLINE -> v8 {
    if constexpr (sizeof(a[0]) == sizeof(v8)) {
        v8 b[4], c[2];
        for (int i = 0; i < 4; ++i)
            b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 8, 1, 9, 4, 12, 5, 13)
                 + __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
        for (int i = 0; i < 2; ++i)
            c[i] = __builtin_shufflevector(b[2 * i], b[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13)
                 + __builtin_shufflevector(b[2 * i], b[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
        return __builtin_shufflevector(c[0], c[1], 0, 1, 2, 3, 8, 9, 10, 11)
             + __builtin_shufflevector(c[0], c[1], 4, 5, 6, 7, 12, 13, 14, 15);
    } else {
        v16 b[4], c[2];
        for (int i = 0; i < 4; ++i)
            b[i] = SHUFFLE_WITHIN_QUARTERS(a[2 * i], a[2 * i + 1], 0, 4, 1, 5)
                 + SHUFFLE_WITHIN_QUARTERS(a[2 * i], a[2 * i + 1], 2, 6, 3, 7);
        for (int i = 0; i < 2; ++i)
            c[i] = SHUFFLE_WITHIN_QUARTERS(b[2 * i], b[2 * i + 1], 0, 1, 4, 5)
                 + SHUFFLE_WITHIN_QUARTERS(b[2 * i], b[2 * i + 1], 2, 3, 6, 7);
        const v8 low = c[0].lo + c[0].hi, high = c[1].lo + c[1].hi;
        return __builtin_shufflevector(low, high, 0, 1, 2, 3, 8, 9, 10, 11)
             + __builtin_shufflevector(low, high, 4, 5, 6, 7, 12, 13, 14, 15);
    }
};
static constexpr auto load = [](const float* p) -> v16 { return *(const v16*)p; };
static constexpr auto store = [](float* p, v16 a) { *(v16*)p = a; };
// Stores the first `lanes` floats. It goes through an array, because indexing a vector by a variable would do so each
// time.
static constexpr auto store_some = [](float* p, v16 a, int lanes) INLINE {
    if (lanes == 16) {
        store(p, a);
        return;
    }
    float all[16];
    store(all, a);
    for (int l = 0; l < lanes; ++l) p[l] = all[l];
};
static constexpr auto clear = [](float* p, long long n) {
    for (long long i = 0; i < n; ++i) p[i] = 0.0f;
};
// `clear` with non-temporal stores, for memory that is not read soon: they bypass the caches and need not read memory
// first.
static constexpr auto clear_past_caches = [](float* p, long long n) {
    typedef float whole __attribute__((ext_vector_type(16), aligned(64)));
    long long i = 0;
    for (; i < n && ((unsigned long long)(p + i) & 63); ++i) p[i] = 0.0f;
    for (; i + 16 <= n; i += 16) __builtin_nontemporal_store((whole)0.0f, (whole*)(p + i));
    for (; i < n; ++i) p[i] = 0.0f;
};
// Interleaves columns: 16 rows of two or three floats, as they lie in memory.
static constexpr auto interleave2 = [](v16 x, v16 y, float* to) INLINE {
    store(to, __builtin_shufflevector(x, y, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23));
    store(to + 16, __builtin_shufflevector(x, y, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31));
};
static constexpr auto interleave3 = [](v16 x, v16 y, v16 z, float* to) INLINE {
    const v16 a = __builtin_shufflevector(x, y, 0, 16, 0, 1, 17, 0, 2, 18, 0, 3, 19, 0, 4, 20, 0, 5);
    const v16 b = __builtin_shufflevector(x, y, 21, 0, 6, 22, 0, 7, 23, 0, 8, 24, 0, 9, 25, 0, 10, 26);
    const v16 c = __builtin_shufflevector(x, y, 0, 11, 27, 0, 12, 28, 0, 13, 29, 0, 14, 30, 0, 15, 31, 0);
    store(to, __builtin_shufflevector(a, z, 0, 1, 16, 3, 4, 17, 6, 7, 18, 9, 10, 19, 12, 13, 20, 15));
    store(to + 16, __builtin_shufflevector(b, z, 0, 21, 2, 3, 22, 5, 6, 23, 8, 9, 24, 11, 12, 25, 14, 15));
    store(to + 32, __builtin_shufflevector(c, z, 26, 1, 2, 27, 4, 5, 28, 7, 8, 29, 10, 11, 30, 13, 14, 31));
};
// Whether 16 ascending row numbers are consecutive, so that whole vectors can be loaded. A list of fewer than 16 rows
// repeats its last row, which makes this false.
static constexpr auto in_a_row = [](const int* row) INLINE -> bool { return row[15] - row[0] == 15 && row[14] < row[15]; };
// `next_rows` takes 16 row numbers from a list of which `lanes` are left; the last one is repeated. `append_rows`
// appends the rows of the lanes in `mask` to a list of `count` rows.
static constexpr auto next_rows = [](const int* list, int lanes, int* row) INLINE {
    for (int l = 0; l < 16; ++l) row[l] = list[smaller(l, lanes - 1)];
};
static constexpr auto append_rows = [](int* list, int& count, const int* row, unsigned mask) INLINE {
    if (mask == 0xffff) {
        *(i16*)(list + count) = *(const i16*)row;
        count += 16;
        return;
    }
    for (; mask; mask &= mask - 1) list[count++] = row[__builtin_ctz(mask)];
};
// Column `c` of 16 rows of an array with `width` columns. `row` holds the row number of each lane.
static constexpr auto gather = [](const float* p, const int* row, int width, int c) INLINE -> v16 {
    if (width == 1 && in_a_row(row)) return load(p + row[0]);
    v16 a;
    for (int l = 0; l < 16; ++l) a[l] = p[row[l] * width + c];
    return a;
};
static constexpr auto scatter = [](float* p, const int* row, v16 a, int lanes) {
    float all[16];
    store(all, a);
    for (int l = 0; l < lanes; ++l) p[row[l]] = all[l];
};
// `gather2`, `gather3` and `gather4` load 16 rows of two to four floats as columns; `scatter2` to `scatter4` store
// them. `row` ascends. A row moves as one vector, four rows share a v16, and 4 x 4 floats are transposed: a third of
// the instructions of moving single floats. Consecutive rows need a quarter of these.
typedef float v4 __attribute__((ext_vector_type(4), aligned(4)));
typedef float v2 __attribute__((ext_vector_type(2), aligned(4)));
// Copies a row of `width` floats. For the usual widths the compiler emits no loop.
static constexpr auto copy_row = [](float* to, const float* from, int width) INLINE {
    switch (width) {
        case 1: *to = *from; return;
        case 2: *(v2*)to = *(const v2*)from; return;
        case 3:
            *(v2*)to = *(const v2*)from;
            to[2] = from[2];
            return;
        case 4: *(v4*)to = *(const v4*)from; return;
        default:
            for (int j = 0; j < width; ++j) to[j] = from[j];
    }
};
// Transposes the 4 x 4 floats that a quarter has in four vectors, for each of the four quarters.
static constexpr auto transpose_4x4 = [](const v16* a, v16* b) INLINE {
    v16 low[2], high[2];
    for (int i = 0; i < 2; ++i) {
        low[i] = SHUFFLE_WITHIN_QUARTERS(a[2 * i], a[2 * i + 1], 0, 4, 1, 5);
        high[i] = SHUFFLE_WITHIN_QUARTERS(a[2 * i], a[2 * i + 1], 2, 6, 3, 7);
    }
    for (int i = 0; i < 2; ++i) {
        const v16 *c = i ? high : low;
        b[2 * i] = SHUFFLE_WITHIN_QUARTERS(c[0], c[1], 0, 1, 4, 5);
        b[2 * i + 1] = SHUFFLE_WITHIN_QUARTERS(c[0], c[1], 2, 3, 6, 7);
    }
};
static constexpr auto join = [](const v4* r) INLINE -> v16 {
    const auto low = __builtin_shufflevector(r[0], r[1], 0, 1, 2, 3, 4, 5, 6, 7);
    const auto high = __builtin_shufflevector(r[2], r[3], 0, 1, 2, 3, 4, 5, 6, 7);
    return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
};
static constexpr auto gather_four_columns = [](const float* p, const int* row, int width, v16* columns) INLINE {
    v16 a[4];
    for (int i = 0; i < 4; ++i) {
        v4 r[4];
        for (int k = 0; k < 4; ++k) r[k] = *(const v4*)(p + row[4 * k + i] * width);
        a[i] = join(r);
    }
    transpose_4x4(a, columns);
};
static constexpr auto gather4 = [](const float* p, const int* row, v16* columns) INLINE {
    if (!in_a_row(row)) return gather_four_columns(p, row, 4, columns);
    v16 rows[4], a[4];
    for (int i = 0; i < 4; ++i) rows[i] = load(p + 4 * row[0] + 16 * i);
    transpose_4x4(rows, a);  // lane 4 q + i holds row 4 i + q
    for (int c = 0; c < 4; ++c)
        columns[c] = __builtin_shufflevector(a[c], a[c], 0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
};
// The array has `n` rows: a load of three floats also reads a fourth, which belongs to the next row.
static constexpr auto gather3 = [](const float* p, const int* row, int n, v16* columns) INLINE {
    if (in_a_row(row)) {
        const v16 a = load(p + 3 * row[0]), b = load(p + 3 * row[0] + 16), c = load(p + 3 * row[0] + 32);
        const v16 x = __builtin_shufflevector(a, b, 0, 3, 6, 9, 12, 15, 18, 21, 24, 27, 30, 0, 0, 0, 0, 0);
        const v16 y = __builtin_shufflevector(a, b, 1, 4, 7, 10, 13, 16, 19, 22, 25, 28, 31, 0, 0, 0, 0, 0);
        const v16 z = __builtin_shufflevector(a, b, 2, 5, 8, 11, 14, 17, 20, 23, 26, 29, 0, 0, 0, 0, 0, 0);
        columns[0] = __builtin_shufflevector(x, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 17, 20, 23, 26, 29);
        columns[1] = __builtin_shufflevector(y, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 18, 21, 24, 27, 30);
        columns[2] = __builtin_shufflevector(z, c, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 19, 22, 25, 28, 31);
        return;
    }
    if (row[15] + 1 < n) {
        v16 all[4];
        gather_four_columns(p, row, 3, all);
        for (int c = 0; c < 3; ++c) columns[c] = all[c];
        return;
    }
    for (int c = 0; c < 3; ++c) columns[c] = gather(p, row, 3, c);
};
static constexpr auto gather2 = [](const float* p, const int* row, v16* columns) INLINE {
    v16 half[2];
    if (in_a_row(row)) {
        half[0] = load(p + 2 * row[0]), half[1] = load(p + 2 * row[0] + 16);
    } else
        for (int i = 0; i < 2; ++i) {
            v4 r[4];
            for (int k = 0; k < 4; ++k) {
                const v2 a = *(const v2*)(p + 2 * row[8 * i + 2 * k]), b = *(const v2*)(p + 2 * row[8 * i + 2 * k + 1]);
                r[k] = __builtin_shufflevector(a, b, 0, 1, 2, 3);
            }
            half[i] = join(r);
        }
    columns[0] = __builtin_shufflevector(half[0], half[1], 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    columns[1] = __builtin_shufflevector(half[0], half[1], 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
};
static constexpr auto scatter_rows = [](float* p, const int* row, int width, const v16* columns, int lanes) INLINE {
    alignas(64) v16 a[4];
    transpose_4x4(columns, a);
    const float* moved = (const float*)a;
    for (int l = 0; l < lanes; ++l) {
        const float* from = moved + 16 * (l & 3) + 4 * (l >> 2);
        float* to = p + row[l] * width;
        *(v2*)to = *(const v2*)from;
        if (width == 3) to[2] = from[2];
        if (width == 4) *(v2*)(to + 2) = *(const v2*)(from + 2);
    }
};
static constexpr auto scatter2 = [](float* p, const int* row, v16 x, v16 y, int lanes) INLINE {
    if (in_a_row(row)) return interleave2(x, y, p + 2 * row[0]);
    const v16 columns[4] = {x, y, x, y};
    scatter_rows(p, row, 2, columns, lanes);
};
static constexpr auto scatter3 = [](float* p, const int* row, v16 x, v16 y, v16 z, int lanes) INLINE {
    if (in_a_row(row)) return interleave3(x, y, z, p + 3 * row[0]);
    const v16 columns[4] = {x, y, z, z};
    scatter_rows(p, row, 3, columns, lanes);
};
static constexpr auto scatter4 = [](float* p, const int* row, v16 x, v16 y, v16 z, v16 w, int lanes) INLINE {
    const v16 columns[4] = {x, y, z, w};
    scatter_rows(p, row, 4, columns, lanes);
};
// Transposes 16 x 16 floats in four rounds: rows that are `step` apart exchange the lanes that are `step` apart.
static constexpr auto transpose = [](v16* a) INLINE {
    auto exchange = [a](int step, auto low, auto high) INLINE {
#pragma clang loop unroll(full)
        for (int i = 0; i < 16; ++i)
            if (!(i & step)) {
                const v16 b = low(a[i], a[i + step]), c = high(a[i], a[i + step]);
                a[i] = b;
                a[i + step] = c;
            }
    };
    auto low8 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23);
    };
    auto high8 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
    };
    auto low4 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27);
    };
    auto high4 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    };
    auto low2 = [](v16 a, v16 b) -> v16 { return SHUFFLE_WITHIN_QUARTERS(a, b, 0, 1, 4, 5); };
    auto high2 = [](v16 a, v16 b) -> v16 { return SHUFFLE_WITHIN_QUARTERS(a, b, 2, 3, 6, 7); };
    auto low1 = [](v16 a, v16 b) -> v16 { return SHUFFLE_WITHIN_QUARTERS(a, b, 0, 4, 2, 6); };
    auto high1 = [](v16 a, v16 b) -> v16 { return SHUFFLE_WITHIN_QUARTERS(a, b, 1, 5, 3, 7); };
    exchange(8, low8, high8);
    exchange(4, low4, high4);
    exchange(2, low2, high2);
    exchange(1, low1, high1);
};

// 2^t for t in [-126, 126]. The rounded integer goes to the exponent; a minimax polynomial of degree 5 gives 2^f for
// the rest f in [-0.5, 0.5], with a relative error of 7.5e-8.
static constexpr auto exp2 = [](auto t) INLINE {
    using V = decltype(t);
    using I = decltype(t < t);
    const auto fraction = [](V f) INLINE -> V {
        V p = 1.327645461e-3f * f + 9.675540368e-3f;
        p = p * f + 5.550713310e-2f;
        p = p * f + 2.402211974e-1f;
        p = p * f + 6.931469671e-1f;
        return p * f + 1.000000072f;
    };
#if defined(__AVX512F__) && __has_builtin(__builtin_ia32_scalefps512_mask)
    if constexpr (sizeof(V) == 64) {
        typedef float whole __attribute__((vector_size(64)));
        const V n = __builtin_elementwise_roundeven(t);
        return (V)__builtin_ia32_scalefps512_mask((whole)fraction(t - n), (whole)n, (whole)t, (unsigned short)-1, 4);
    }
#endif
    // Adding 1.5 * 2^23 leaves the rounded integer in the low mantissa bits.
    const V magic = (V)12582912.0f;
    const V r = t + magic;
    return (V)((I)fraction(t - (r - magic)) + ((I)r << 23));
};
// e^x. The product with log2(e) has two parts for accuracy. Saturates at the ends of the range of float.
static constexpr auto vexp = [](v16 x) INLINE -> v16 {
#pragma clang fp contract(off)
    const v16 magic = (v16)12582912.0f;
    x = x < -87.0f ? (v16)-87.0f : (x > 88.0f ? (v16)88.0f : x);
    const v16 r = x * 1.44269502f + magic, whole = r - magic;
    const v16 f = __builtin_elementwise_fma(x, (v16)1.44269502f, -whole) + x * 1.92596303e-8f;
    const v16 p = exp2(f);
    return (v16)((i16)p + ((i16)r << 23));
};
static constexpr auto sigmoid = [](v16 x) INLINE -> v16 { return 1.0f / (1.0f + vexp(-x)); };

// log2(a) for positive, normal `a`: the exponent's bits plus the atanh series of the mantissa in [sqrt(1/2), sqrt(2)).
static constexpr auto log2 = [](v16 a) -> v16 {
    i16 bits = (i16)a + (0x3f800000 - 0x3f3504f3);
    v16 exponent = __builtin_convertvector((bits >> 23) - 127, v16);
    v16 m = (v16)((bits & 0x007fffff) + 0x3f3504f3);
    v16 t = (m - 1.0f) / (m + 1.0f);
    v16 u = t * t;
    v16 p = u * (u * (u * (u * (1.0f / 9.0f) + 1.0f / 7.0f) + 0.2f) + 1.0f / 3.0f) + 1.0f;
    return exponent + t * p * 2.88539008f;
};
