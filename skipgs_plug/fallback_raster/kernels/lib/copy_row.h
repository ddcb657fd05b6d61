// A row of a few numbers: what the compiler knows the width of needs no loop.
static constexpr auto copy_row = [](float* to, const float* from, int width) INLINE {
    switch (width) {
        case 1: *to = *from; return;
        case 2: *(v2*)to = *(const v2*)from; return;
        case 3:
            *(v2*)to = *(const v2*)from;
            to[2] = from[2];
            return;
        case 4: *(v4*)to = *(const v4*)from; return;
        default:
            for (int j = 0; j < width; ++j) to[j] = from[j];
    }
};
