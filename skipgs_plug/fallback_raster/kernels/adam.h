// One step for all rows, or for those that are seen.
#include "lib/adam_step.h"
for (int row = first; row < last;) {
    if (only_seen && !seen[row]) {
        ++row;
        continue;
    }
    // A run of rows is one line of floats.
    const long long begin = (long long)row * width;
    if (only_seen) while (row < last && seen[row]) ++row;
    else row = last;
    const long long end = (long long)row * width, whole = begin + (end - begin) / 16 * 16;
    for (long long i = begin; i < whole; i += 16) {
        const v16 g = load(gradient + i);
        v16 m = load(mean + i), s = load(square + i);
        // Nothing changes where there never was a gradient: without writing it takes two thirds of the time.
        if (!bits((g != 0.0f) | (m != 0.0f) | (s != 0.0f)) && eps > 0.0f) continue;
        v16 x = load(values + i);
        advance(g, m, s, x, rate, root);
        store(mean + i, m);
        store(square + i, s);
        store(values + i, x);
    }
    if (whole == end) continue;
    v16 g = (v16)0.0f, m = g, s = g, x = g;
    const int rest = end - whole;
    for (int j = 0; j < rest; ++j) {
        g[j] = gradient[whole + j];
        m[j] = mean[whole + j];
        s[j] = square[whole + j];
        x[j] = values[whole + j];
    }
    advance(g, m, s, x, rate, root);
    for (int j = 0; j < rest; ++j) {
        mean[whole + j] = m[j];
        square[whole + j] = s[j];
        values[whole + j] = x[j];
    }
}
