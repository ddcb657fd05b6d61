// Puts further channels of colour into the records.
#include "lib/slice_begin.h"
for (int s = first; s < last; ++s) {
    const int begin = slice_begin(s, n, slices);
    for (int k = begin; k < begin + listed_count[s]; ++k)
        for (int c = 0; c < channels; ++c)
            records[(long long)RECORD * k + 8 + c] = colors[(long long)visible[listed[k]] * stride + channel + c];
}
