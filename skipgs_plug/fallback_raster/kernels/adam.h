// One step for the rows that are seen.
const long long block_end = (long long)last * width;
for (int row = first; row < last;) {
    if (!seen[row]) {
        ++row;
        continue;
    }
    // A run of visible rows is one line of floats. What a vector holds beyond its end is written back as it was.
    const long long begin = (long long)row * width;
    while (row < last && seen[row]) ++row;
    const long long end = (long long)row * width;
    for (long long i = begin; i < end; i += 16) {
        if (i + 16 > block_end) {  // a whole vector would reach into rows of another core
            for (long long j = i; j < end; ++j) {
                const float g = gradient[j];
                mean[j] = keep1 * mean[j] + take1 * g;
                square[j] = keep2 * square[j] + take2 * g * g;
                values[j] -= rate * mean[j] / (__builtin_elementwise_sqrt(square[j]) + eps);
            }
            break;
        }
        const i16 own = lane < (float)(end - i < 16 ? end - i : 16);
        const v16 g = load(gradient + i), m = load(mean + i), s = load(square + i), x = load(values + i);
        const v16 new_m = keep1 * m + take1 * g, new_s = keep2 * s + take2 * g * g;
        store(mean + i, own ? new_m : m);
        store(square + i, own ? new_s : s);
        store(values + i, own ? x - rate * new_m / (vsqrt(new_s) + eps) : x);
    }
}
