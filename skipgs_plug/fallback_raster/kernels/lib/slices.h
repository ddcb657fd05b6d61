// Slices of the visible Gaussians.
#pragma once
#include "simd.h"

// The first visible Gaussian of slice `s`. The slice before it ends there.
static constexpr auto slice_begin = [](int s, const Slices& slices) -> int {
    return (int)((long long)s * slices.m / slices.number);
};
