// Which visible rows of a block have a gradient of their colour: nothing blended the others, or they were clamped.
int count = 0;
for (int i = block_start[first]; i < block_start[first + 1]; ++i) {
    const int g = visible[i];
    bool some = false;
    for (int c = 0; c < 3; ++c) some |= colors[3 * g + c] > 0.0f && v_colors[3 * g + c] != 0.0f;
    if (some) colored[(long long)BLOCK * first + count++] = g;
}
block_count[first] = count;
