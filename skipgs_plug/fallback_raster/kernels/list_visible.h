// The visible rows of all blocks one after the other, and where each block begins among them.
int m = 0;
for (int b = 0; b < blocks; ++b) {
    block_start[b] = m;
    for (int i = 0; i < block_count[b]; ++i) visible[m++] = seen[(long long)BLOCK * b + i];
}
block_start[blocks] = m;
