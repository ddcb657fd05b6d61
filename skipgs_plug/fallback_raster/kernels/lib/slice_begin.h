// The first of `n` rows that belongs to slice `s`; the slice before it ends there.
static constexpr auto slice_begin = [](int s, int n, int slices) -> int { return (int)((long long)s * n / slices); };
