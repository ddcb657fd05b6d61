// Tiles of a box of a few of them, as bits of an int that is not negative, row by row.
static constexpr int BOX_COLUMNS = 6, BOX_ROWS = 5;
static constexpr int TWO_BY_TWO = 3 | 3 << BOX_COLUMNS;
int offset[BOX_COLUMNS * BOX_ROWS];  // from the first tile to that of each bit
for (int j = 0; j < BOX_COLUMNS * BOX_ROWS; ++j) offset[j] = j / BOX_COLUMNS * tiles_x + j % BOX_COLUMNS;
