// Some rows of an array, packed.
#include "lib/copy_row.h"
for (int i = first; i < last; ++i) copy_row(taken + (long long)width * i, source + (long long)width * rows[i], width);
