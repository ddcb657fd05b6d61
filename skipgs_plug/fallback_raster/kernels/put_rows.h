// Packed rows back to their places, zeros between them, one block of rows at a time.
#include "lib/copy_row.h"
for (int block = first; block < last; ++block) {
    const int row_begin = BLOCK * block;
    clear(put + (long long)width * row_begin, (long long)width * smaller(BLOCK, n - row_begin));
    for (int i = block_start[block]; i < block_start[block + 1]; ++i)
        copy_row(put + (long long)width * rows[i], packed + (long long)width * i, width);
}
