// Puts further channels of colour into the records.
for (int i = first; i < last; ++i)
    for (int k = 0; k < channels; ++k)
        records[(long long)RECORD * visible[i] + 8 + k] = colors[(long long)visible[i] * stride + channel + k];
