// Slots for the sums of the pairs that were blended, tile after tile, part after part of the lists.
//
// One thread: neighbours in a list are rows from anywhere, and several would pass the same cache lines to and fro.
int slot = 0;
for (int part = 0; part < parts; ++part)
    for (int t = 0; t < tiles; ++t) {
        slot_start[part * tiles + t] = slot;
        const int begin = part ? far_start[t] : tile_start[t], end = part ? far_stop[t] : tile_stop[t];
        for (int k = begin; k < end; ++k)
            if (pair_blocks[k]) pair_slot[tile_place[k]] = ++slot;
    }
slot_start[parts * tiles] = slot;
