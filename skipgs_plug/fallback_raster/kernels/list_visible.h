// The visible rows of all blocks one after the other, and where each block begins among them.
int m = 0;
for (int b = 0; b < blocks; ++b) {
    block_start[b] = m;
    __builtin_memcpy(visible + m, seen + (long long)BLOCK * b, sizeof(int) * block_count[b]);
    m += block_count[b];
}
block_start[blocks] = m;
