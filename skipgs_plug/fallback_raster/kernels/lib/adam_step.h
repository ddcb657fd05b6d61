// One step of Adam for 16 numbers.
#pragma once
#include "simd.h"

// Rounded as torch rounds its fused Adam: one multiply-add for either mean, everything else operation by operation.
// A mean below the smallest normal number counts as zero: arithmetic on such numbers takes 40 times as long, and the
// mean of a row without gradients would stay among them for ever.
static constexpr auto adam_step = [](const Decay& decay, v16 g, v16& m, v16& s, v16& x, float rate, float root) INLINE {
#pragma clang fp contract(off)
    const v16 towards = g - m, kept = decay.keep2 * s, added = decay.take2 * g;
    {
#pragma clang fp contract(fast)
        m = m + decay.take1 * towards;
        s = kept + added * g;
    }
    m = vabs(m) < 1.17549435e-38f ? (v16)0.0f : m;
    x = x + -rate * m / (vsqrt(s) / root + decay.eps);
};
