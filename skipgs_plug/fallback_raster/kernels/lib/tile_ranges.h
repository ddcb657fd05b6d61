// Depths, as bits, that are listed in a tile: from the first of its two numbers up to the second, exclusive.
static constexpr int NO_DEPTH = 0x7fffffff;
static constexpr auto in_range = [](const int* ranges, int tile, int depth) INLINE -> bool {
    return depth >= ranges[2 * tile] && depth < ranges[2 * tile + 1];
};
