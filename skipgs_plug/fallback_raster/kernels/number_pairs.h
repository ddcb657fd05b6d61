// Slots for the sums of the pairs that were blended, tile after tile, part after part of the lists.
for (int item = first; item < last; ++item) {
    const bool far = item >= tiles;
    const int t = far ? item - tiles : item, end = far ? far_stop[t] : tile_stop[t];
    int slot = slot_start[item];
    for (int k = far ? far_start[t] : tile_start[t]; k < end; ++k)
        if (pair_blocks[k]) pair_slot[tile_place[k]] = ++slot;
}
