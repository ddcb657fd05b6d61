// Replaces the colours in the records by the channels of the next pass.
//
// Reads `colors` of the listed rows. Writes the colours in the records of its own slices. No other thread writes to
// them.
#pragma once
#include "lib/record.h"
#include "lib/slices.h"
static constexpr auto pack_colors = [](const int* visible, const RecordList& packed, const float* colors,
                                       const Channels& channels, const Slices& slices, int n, int first, int last) INLINE {
    for (int s = first; s < last; ++s) {
        const int begin = slice_begin(s, slices);
        for (int k = begin; k < begin + packed.listed_count[s]; ++k) {
            const float* color = colors + (long long)visible[packed.listed[k]] * channels.stride + channels.first;
            for (int c = 0; c < channels.number; ++c) packed.records[k].color[c] = color[c];
        }
    }
};
