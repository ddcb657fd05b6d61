// One Adam step for all rows, or for the rows that `wanted` marks.
//
// Reads `gradient`. Updates the parameter and both moments of its own rows. No other thread writes to these rows.
#pragma once
#include "lib/adam_step.h"
static constexpr auto adam = [](const int* wanted, const float* gradient, const Moments& parameter, const Decay& decay,
                                int n, int width, int only_some, float rate, float root, int first, int last) INLINE {
    for (int row = first; row < last;) {
        if (only_some && !wanted[row]) {
            ++row;
            continue;
        }
        // Neighbouring rows are one contiguous run of floats.
        const long long begin = (long long)row * width;
        if (only_some) while (row < last && wanted[row]) ++row;
        else row = last;
        const long long end = (long long)row * width, whole = begin + (end - begin) / 16 * 16;
        for (long long i = begin; i < whole; i += 16) {
            const v16 g = load(gradient + i);
            v16 m = load(parameter.mean + i), s = load(parameter.square + i);
            // Where gradient and moments are zero the step changes nothing. Skipping the stores saves a third of the
            // time.
            if (!bits((g != 0.0f) | (m != 0.0f) | (s != 0.0f)) && decay.eps > 0.0f) continue;
            v16 x = load(parameter.values + i);
            adam_step(decay, g, m, s, x, rate, root);
            store(parameter.mean + i, m);
            store(parameter.square + i, s);
            store(parameter.values + i, x);
        }
        if (whole == end) continue;
        v16 g = (v16)0.0f, m = g, s = g, x = g;
        const int tail = end - whole;
        for (int j = 0; j < tail; ++j) {
            g[j] = gradient[whole + j];
            m[j] = parameter.mean[whole + j];
            s[j] = parameter.square[whole + j];
            x[j] = parameter.values[whole + j];
        }
        adam_step(decay, g, m, s, x, rate, root);
        for (int j = 0; j < tail; ++j) {
            parameter.mean[whole + j] = m[j];
            parameter.square[whole + j] = s[j];
            parameter.values[whole + j] = x[j];
        }
    }
};
