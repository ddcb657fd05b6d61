// Vector code that every kernel begins with.
//
// Warp compiles kernels with its own Clang, also on machines without a compiler, and takes C++ that may use Clang's
// vector extension. A value of `v16` holds 16 neighbouring pixels (or 16 Gaussians); arithmetic on it reads like scalar
// code and becomes one AVX-512 instruction, two of AVX2 or four of SSE or NEON. Scalar Warp code does not vectorise
// across pixels.
//
// A kernel is the body of one function, where C++ allows no other: functions are lambdas without captures. The text of
// this file comes first in every kernel, the constants of `constants.py` follow by name.

// Lets Clang fuse a * b + c into one instruction, which is faster and rounds once; Warp leaves it off. It reaches into
// lambdas but not into member functions, which say it again.
#pragma clang fp contract(fast)
// Inlined before Clang optimises: which products it fuses with which sums then depends less on where its text was cut.
#define INLINE __attribute__((always_inline))

typedef float v16 __attribute__((ext_vector_type(16), aligned(4)));
typedef int i16 __attribute__((ext_vector_type(16), aligned(4)));
typedef bool b16 __attribute__((ext_vector_type(16)));
typedef float v8 __attribute__((ext_vector_type(8), aligned(4)));

static constexpr float LOG2_E = 1.44269504f, LN_4 = 1.38629436f;

static constexpr v16 lane = {0.f, 1.f, 2.f, 3.f, 4.f, 5.f, 6.f, 7.f, 8.f, 9.f, 10.f, 11.f, 12.f, 13.f, 14.f, 15.f};
// Where each lane lies in a block of 4 x 4.
static constexpr v16 lane_x = {0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f, 0.f, 1.f, 2.f, 3.f};
static constexpr v16 lane_y = {0.f, 0.f, 0.f, 0.f, 1.f, 1.f, 1.f, 1.f, 2.f, 2.f, 2.f, 2.f, 3.f, 3.f, 3.f, 3.f};
static constexpr auto fmaxf = [](float a, float b) -> float { return a > b ? a : b; };
static constexpr auto fminf = [](float a, float b) -> float { return a < b ? a : b; };
static constexpr auto larger = [](int a, int b) -> int { return a > b ? a : b; };
static constexpr auto smaller = [](int a, int b) -> int { return a < b ? a : b; };
static constexpr auto any = [](i16 mask) -> bool { return __builtin_reduce_or(mask) != 0; };
// Bit l is set where lane l of the mask is.
static constexpr auto bits = [](i16 mask) -> unsigned {
    return __builtin_bit_cast(unsigned short, __builtin_convertvector(mask != 0, b16));
};
// One instruction each; where one of the two is NaN, the second is taken.
static constexpr auto vmin = [](v16 a, v16 b) -> v16 { return a < b ? a : b; };
static constexpr auto vmax = [](v16 a, v16 b) -> v16 { return a > b ? a : b; };
static constexpr auto vabs = [](v16 a) -> v16 { return __builtin_elementwise_abs(a); };
static constexpr auto vsqrt = [](v16 a) -> v16 { return __builtin_elementwise_sqrt(a); };
// Pairwise, so that the order of additions (and the result to the bit) is fixed.
static constexpr auto sum = [](v16 a) -> float {
    auto b = a.lo + a.hi;
    auto c = b.lo + b.hi;
    auto d = c.lo + c.hi;
    return d.x + d.y;
};
// Eight sums at a time, folded together: a third of the instructions of eight calls of `sum`.
static constexpr auto sum8 = [](const v16* a) -> v8 {
    v16 b[4], c[2];
    for (int i = 0; i < 4; ++i)
        b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
             + __builtin_shufflevector(a[2 * i], a[2 * i + 1], 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30,
                                       31);
    for (int i = 0; i < 2; ++i)
        c[i] = __builtin_shufflevector(b[2 * i], b[2 * i + 1], 0, 1, 2, 3, 8, 9, 10, 11, 16, 17, 18, 19, 24, 25, 26, 27)
             + __builtin_shufflevector(b[2 * i], b[2 * i + 1], 4, 5, 6, 7, 12, 13, 14, 15, 20, 21, 22, 23, 28, 29, 30,
                                       31);
    v16 d = __builtin_shufflevector(c[0], c[1], 0, 1, 4, 5, 8, 9, 12, 13, 16, 17, 20, 21, 24, 25, 28, 29)
          + __builtin_shufflevector(c[0], c[1], 2, 3, 6, 7, 10, 11, 14, 15, 18, 19, 22, 23, 26, 27, 30, 31);
    return d.even + d.odd;
};
static constexpr auto load = [](const float* p) -> v16 { return *(const v16*)p; };
static constexpr auto store = [](float* p, v16 a) { *(v16*)p = a; };
static constexpr auto clear = [](float* p, long long n) {
    for (long long i = 0; i < n; ++i) p[i] = 0.0f;
};
// 16 rows of an array of structures, column `c`; `row` names the row of each lane.
static constexpr auto gather = [](const float* p, const int* row, int width, int c) -> v16 {
    v16 a;
    for (int l = 0; l < 16; ++l) a[l] = p[row[l] * width + c];
    return a;
};
static constexpr auto scatter = [](float* p, const int* row, int width, int c, v16 a, int lanes) {
    for (int l = 0; l < lanes; ++l) p[row[l] * width + c] = a[l];
};
// Rows become columns in four rounds: rows `step` apart exchange the lanes that lie `step` apart.
static constexpr auto transpose = [](v16* a) {
    auto exchange = [a](int step, auto low, auto high) {
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
    auto low2 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29);
    };
    auto high2 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    };
    auto low1 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30);
    };
    auto high1 = [](v16 a, v16 b) -> v16 {
        return __builtin_shufflevector(a, b, 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
    };
    exchange(8, low8, high8);
    exchange(4, low4, high4);
    exchange(2, low2, high2);
    exchange(1, low1, high1);
};

// 2^t for t in [-126, 126]: the integer part goes into the exponent, a degree-5 minimax polynomial gives the rest
// in [-0.5, 0.5] (relative error 7.5e-8). Adding 1.5 * 2^23 leaves the rounded integer in the low mantissa bits.
static constexpr auto exp2 = [](v16 t) -> v16 {
    const v16 magic = (v16)12582912.0f;
    v16 r = t + magic;
    v16 f = t - (r - magic);
    v16 p = 1.327645461e-3f * f + 9.675540368e-3f;
    p = p * f + 5.550713310e-2f;
    p = p * f + 2.402211974e-1f;
    p = p * f + 6.931469671e-1f;
    p = p * f + 1.000000072f;
    return (v16)((i16)p + ((i16)r << 23));
};
// e^x, with the product by log2(e) in two parts; saturates where float's range ends.
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

// BATCH of them, step by step, so that their chains of instructions lie side by side.
static constexpr int BATCH = 4;
static constexpr auto exp2s = [](const v16* t, v16* result) INLINE {
#pragma clang fp contract(fast)
    constexpr float coefficients[] = {9.675540368e-3f, 5.550713310e-2f, 2.402211974e-1f, 6.931469671e-1f, 1.000000072f};
    const v16 magic = (v16)12582912.0f;
    v16 r[BATCH], f[BATCH], p[BATCH];
    for (int i = 0; i < BATCH; ++i) r[i] = t[i] + magic;
    for (int i = 0; i < BATCH; ++i) f[i] = r[i] - magic;
    for (int i = 0; i < BATCH; ++i) f[i] = t[i] - f[i];
    for (int i = 0; i < BATCH; ++i) p[i] = (v16)1.327645461e-3f;
    for (float coefficient : coefficients)
        for (int i = 0; i < BATCH; ++i) p[i] = p[i] * f[i] + coefficient;
    for (int i = 0; i < BATCH; ++i) result[i] = (v16)((i16)p[i] + ((i16)r[i] << 23));
};
// log2(a) for positive, normal a: exponent bits plus the atanh series of the mantissa in [sqrt(1/2), sqrt(2)).
static constexpr auto log2 = [](v16 a) -> v16 {
    i16 bits = (i16)a + (0x3f800000 - 0x3f3504f3);
    v16 exponent = __builtin_convertvector((bits >> 23) - 127, v16);
    v16 m = (v16)((bits & 0x007fffff) + 0x3f3504f3);
    v16 t = (m - 1.0f) / (m + 1.0f);
    v16 u = t * t;
    v16 p = u * (u * (u * (u * (1.0f / 9.0f) + 1.0f / 7.0f) + 0.2f) + 1.0f / 3.0f) + 1.0f;
    return exponent + t * p * 2.88539008f;
};
