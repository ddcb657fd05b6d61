// One step of Adam (Kingma and Ba 2015) for 16 numbers.
#pragma once
#include "simd.h"

// Rounds as torch's fused Adam: one fused multiply-add for each moment, every other operation by itself. A first moment
// below the smallest normal float becomes zero: arithmetic on subnormal numbers takes 40 times as long, and the moment
// of a row without gradients would stay subnormal for ever.
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
