// One core sorts the visible rows by depth while the others pack their records.

// Least significant digit first, 11 bits at a time; depths are positive, so their bits sort like integers. Keys and
// values have two halves, between which they move; the sorted ones end in the second.
static constexpr auto sort_by_depth = [](const float* depths, const int* visible, int* keys, int* values, int n) {
    for (int i = 0; i < n; ++i) {
        keys[i] = ((const int*)depths)[visible[i]];
        values[i] = visible[i];
    }
    int histogram[2048];
    for (int shift = 0; shift < 33; shift += 11) {
        const int* from_keys = shift == 11 ? keys + n : keys;
        const int* from_values = shift == 11 ? values + n : values;
        int* to_keys = shift == 11 ? keys : keys + n;
        int* to_values = shift == 11 ? values : values + n;
        for (int b = 0; b < 2048; ++b) histogram[b] = 0;
        for (int i = 0; i < n; ++i) ++histogram[((unsigned)from_keys[i] >> shift) & 2047];
        int start = 0;
        for (int b = 0; b < 2048; ++b) {
            const int count = histogram[b];
            histogram[b] = start;
            start += count;
        }
        for (int i = 0; i < n; ++i) {
            const int slot = histogram[((unsigned)from_keys[i] >> shift) & 2047]++;
            to_keys[slot] = from_keys[i];
            to_values[slot] = from_values[i];
        }
    }
};

for (int item = first; item < last; ++item) {
    if (item == 0) {
        sort_by_depth(depths, visible, keys, values, n);
        continue;
    }
    const int begin = BLOCK * (item - 1), end = smaller(begin + BLOCK, n);
    for (int i = begin; i < end; i += 16) {
        const int lanes = smaller(16, n - i);
        int row[16];
        for (int l = 0; l < 16; ++l) row[l] = visible[i + smaller(l, lanes - 1)];
        v16 a = gather(conics, row, 3, 0), b = gather(conics, row, 3, 1), c = gather(conics, row, 3, 2);
        v16 log2_opacity = log2(vmax(gather(opacities, row, 1, 0), (v16)1e-20f));
        v16 reach = log2_opacity - LOG2_ALPHA_MIN;
        // a dx^2 + 2 b dx dy + c dy^2 = a (dx + b / a dy)^2 + dy^2 / sigma_y^2: no needle rounds to a negative value.
        v16 along = vsqrt(0.5f * LOG2_E * a), across = vsqrt((v16)(0.5f * LOG2_E)) / gather(sigmas, row, 2, 1);
        // Half axes of the box around alpha >= ALPHA_MIN, a hair wider than exact: the blend tests every pixel itself.
        v16 half = vsqrt(vmax(2.0f * reach / LOG2_E, (v16)0.0f)) * 1.0001f + 1e-3f;
        v16 value[RECORD] = {
            gather(means2d, row, 2, 0), gather(means2d, row, 2, 1), along, along * (b / a), across, log2_opacity,
            half * gather(sigmas, row, 2, 1), half * gather(sigmas, row, 2, 0), {}, {}, {}, {}, -b / a, -b / c, reach};
        for (int k = 0; k < channels; ++k) value[8 + k] = gather(colors, row, stride, k);
        transpose(value);
        for (int l = 0; l < lanes; ++l) store(records + (long long)RECORD * row[l], value[l]);
    }
}
