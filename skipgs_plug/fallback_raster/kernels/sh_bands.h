// Evaluates the SH basis functions of the higher bands (all but the constant one) in each direction.
//
// Reads `directions`. Writes `bands` of its own rows. No other thread writes to these rows.
#pragma once
#include "lib/harmonics.h"
static constexpr auto sh_bands = [](const float* directions, float* bands, int n, int degree, int first, int last) INLINE {
    for (int i = first; i < last; i += 16) {
        const int lanes = smaller(16, last - i);
        int row[16];
        for (int l = 0; l < 16; ++l) row[l] = i + smaller(l, lanes - 1);
        v16 direction[4], basis[16];
        gather4(directions, row, direction);
        for (int band = 0; band < 16; ++band) basis[band] = (v16)0.0f;
        harmonics(direction[0], direction[1], direction[2], degree, basis);
        for (int band = 0; band < HIGHER_COEFFICIENTS; ++band)
            for (int l = 0; l < lanes; ++l) bands[(long long)HIGHER_COEFFICIENTS * row[l] + band] = basis[band + 1][l];
    }
};
