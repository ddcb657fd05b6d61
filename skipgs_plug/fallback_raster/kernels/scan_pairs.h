// Counts become places: where each tile's list begins, where each slice begins in it, where each slice's pairs begin.
// The total is counted in 64 bits; where 32 do not hold it, the places mean nothing and must not be used.
long long all = 0;
for (int t = 0; t < tiles; ++t) {
    tile_start[t] = (int)all;
    for (int s = 0; s < slices; ++s) {
        int& slice = counts[(long long)s * (tiles + SPARE_COUNTS) + t];
        const int count = slice;
        slice = (int)all;
        all += count;
    }
}
tile_start[tiles] = (int)all;
long long before = 0;
for (int s = 0; s < slices; ++s) {
    const long long pairs = totals[s];
    totals[s] = before;
    before += pairs;
}
totals[slices] = before;
