// Colours of the visible rows of one block, 16 at a time; zero for the others where `dense`.
#include "lib/sh_basis.h"
const int block = first, terms = (degree + 1) * (degree + 1), end = block_start[block + 1];
const int all = block_start[(n + BLOCK - 1) / BLOCK];
if (dense) clear(colors + 3ll * BLOCK * block, 3 * smaller(BLOCK, n - BLOCK * block));
for (int i = block_start[block]; i < end; i += 16) {
    const int lanes = smaller(16, end - i);
    int row[16];
    take_rows(visible + i, lanes, row);
    for (int l = 0; l < 16; ++l)
        fetch_bands(rest + rest_offset, visible[smaller(i + 16 + l, all - 1)], rest_stride, 3 * (terms - 1));
    v16 basis[16], sh[48], constant[3], c[3], x, y, z, norm, shrink;
    directions(means, row, n, camera, x, y, z, norm, shrink);
    harmonics(x, y, z, degree, basis);
    take_constants(base, row, n, base_stride, constant);
    take_bands(rest + rest_offset, row, rest_stride, 3 * (terms - 1), sh);
    for (int k = 0; k < 3; ++k) c[k] = 0.5f + basis[0] * constant[k];
    for (int band = 1; band < terms; ++band)
        for (int k = 0; k < 3; ++k) c[k] += basis[band] * sh[3 * band - 3 + k];
    // Written so that NaN stays NaN: a bad coefficient must be seen in the pixels it touches.
    for (int k = 0; k < 3; ++k) c[k] = c[k] < 0.0f ? (v16)0.0f : c[k];
    scatter3(colors, row, c[0], c[1], c[2], lanes);
}
