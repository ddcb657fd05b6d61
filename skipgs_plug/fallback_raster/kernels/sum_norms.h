// Norms of the gradients of packed 2D means, added to the sums of their rows.
for (int i = first; i < last; ++i) {
    const float x = gradient[2 * i] * scale_x, y = gradient[2 * i + 1] * scale_y;
    norms[rows[i]] += __builtin_sqrtf(x * x + y * y);
    counts[rows[i]] += 1.0f;
}
