// Rows with a radius, and where each block of rows begins among them.
int m = 0;
for (int i = 0; i < n; ++i) {
    if (i % BLOCK == 0) block_start[i / BLOCK] = m;
    visible[m] = i;
    m += radii[2 * i] > 0;
}
block_start[(n + BLOCK - 1) / BLOCK] = m;
