// Colours of the visible rows of one block; zero for the others where `dense`.
#include "sh_basis.h"
const int block = first;
if (dense) clear(colors + 3ll * BLOCK * block, 3 * smaller(BLOCK, n - BLOCK * block));
for (int i = block_start[block]; i < block_start[block + 1]; ++i) {
    const int g = visible[i];
    float basis[16], x, y, z, norm, shrink;
    harmonics(means + 3ll * g, camera, degree, basis, x, y, z, norm, shrink);
    const int terms = (degree + 1) * (degree + 1);
    const float* constant = base + (long long)g * base_stride;
    const float* sh = rest + (long long)g * rest_stride + rest_offset - 3;  // sh[3 k] is band k, from 1 on
    float c0 = 0.5f + basis[0] * constant[0];
    float c1 = 0.5f + basis[0] * constant[1];
    float c2 = 0.5f + basis[0] * constant[2];
    for (int k = 1; k < terms; ++k) {
        c0 += basis[k] * sh[3 * k];
        c1 += basis[k] * sh[3 * k + 1];
        c2 += basis[k] * sh[3 * k + 2];
    }
    // Written so that NaN stays NaN: a bad coefficient must be seen in the pixels it touches.
    colors[3 * g] = c0 < 0.0f ? 0.0f : c0;
    colors[3 * g + 1] = c1 < 0.0f ? 0.0f : c1;
    colors[3 * g + 2] = c2 < 0.0f ? 0.0f : c2;
}
