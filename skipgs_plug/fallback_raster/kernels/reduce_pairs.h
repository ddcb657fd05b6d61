// Adds up the pairs of each row in a fixed order and turns their moments into gradients.
for (int g = first; g < last; ++g) {
    v16 sums = (v16)0.0f;
    for (int j = pair_start[g]; j < pair_start[g + 1]; ++j) {
        // Pairs lie in the order of tiles: ask for the ones to come, also those of the next Gaussians.
        __builtin_prefetch(v_pairs + (long long)PAIR * pair_slot[smaller(j + 16, pairs - 1)]);
        sums += load(v_pairs + (long long)PAIR * pair_slot[j]);
    }
    float total[PAIR];
    store(total, sums);
    const float a = conics[3 * g], b = conics[3 * g + 1], c = conics[3 * g + 2];
    const float v_center[2] = {-(a * total[1] + b * total[2]), -(b * total[1] + c * total[2])};
    const float v_conic[3] = {0.5f * total[3], total[4], 0.5f * total[5]};
    const float v_opacity = total[0] == 0.0f ? 0.0f : -total[0] / opacities[g];
    const bool more = channel > 0;
    for (int j = 0; j < 2; ++j) v_means2d[2 * g + j] = v_center[j] + (more ? v_means2d[2 * g + j] : 0.0f);
    for (int j = 0; j < 3; ++j) v_conics[3 * g + j] = v_conic[j] + (more ? v_conics[3 * g + j] : 0.0f);
    v_opacities[g] = v_opacity + (more ? v_opacities[g] : 0.0f);
    for (int j = 0; j < channels; ++j) v_colors[(long long)g * stride + channel + j] = total[6 + j];
    if (absgrad)
        for (int j = 0; j < 2; ++j) v_absolute[2 * g + j] += LN_4 * total[10 + j];
}
