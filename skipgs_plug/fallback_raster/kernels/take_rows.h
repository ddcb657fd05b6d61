// Some rows of two numbers.
for (int i = first; i < last; ++i) *(v2*)(taken + 2ll * i) = *(const v2*)(source + 2ll * rows[i]);
