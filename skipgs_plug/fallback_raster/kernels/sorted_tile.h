// The list of one tile, sorted front to back as far as somebody asks: behind what fills its pixels nobody does.
//
// Pairs are dealt into buckets of equal ranges of the depth's bits, and buckets are sorted when their turn comes. Equal
// depths keep the order of the rows, which is that of the numbers in the lower half.
static constexpr int LARGE = 16;  // buckets above this are merged from runs of this
struct SortedTile {
    long long *dealt, *other;  // the tile's pairs in buckets, and as much room again
    int *rows, *places;        // out: row and number of each pair
    const int* pair_row;
    int count, done, next;  // pairs, those that are sorted, and the next bucket
    int start[BUCKETS + 1];

    SortedTile(int begin, int end, long long* unsorted, long long* buffer, int* tile_list, int* tile_place,
               const int* pair_row)
        : dealt(buffer + begin), other(unsorted + begin), rows(tile_list + begin), places(tile_place + begin),
          pair_row(pair_row), count(end - begin), done(0), next(0) {
        int least = 0x7fffffff, most = 0;
        for (int i = 0; i < count; ++i) {
            const int key = (int)(other[i] >> 32);
            least = smaller(least, key), most = larger(most, key);
        }
        // Twice as many buckets as pairs: most of them hold one or none.
        int buckets = 64, shift = 0;
        while (buckets < 2 * count && buckets < BUCKETS) buckets *= 2;
        while ((most - least) >> shift >= buckets) ++shift;
        for (int b = 0; b <= buckets; ++b) start[b] = 0;
        for (int i = 0; i < count; ++i) ++start[((int)(other[i] >> 32) - least) >> shift];
        int sum = 0;
        for (int b = 0; b <= buckets; ++b) {
            const int pairs = start[b];
            start[b] = sum;
            sum += pairs;
        }
        for (int i = 0; i < count; ++i) dealt[start[((int)(other[i] >> 32) - least) >> shift]++] = other[i];
        // Dealing left every bucket's end where its start was.
    }

    // Sorts at least the first `wanted` pairs, or all.
    void sort(int wanted) {
        wanted = smaller(wanted, count);
        if (done >= wanted) return;
        int end = done;
        for (int begin = done; end < wanted; begin = end) {
            end = start[next++];
            if (end - begin > LARGE) sort_bucket(begin, end);
        }
        // What is left to do is short: no pair has to move farther than its bucket is long.
        insert(done, end);
        for (; done < end; ++done) {
            places[done] = (int)dealt[done];
            rows[done] = pair_row[places[done]];
        }
    }

  private:
    void insert(int begin, int end) {
        for (int i = begin + 1; i < end; ++i) {
            const long long pair = dealt[i];
            int j = i;
            for (; j > begin && dealt[j - 1] > pair; --j) dealt[j] = dealt[j - 1];
            dealt[j] = pair;
        }
    }

    // By insertion in runs, which are then merged.
    void sort_bucket(int begin, int end) {
        for (int run = begin; run < end; run += LARGE) insert(run, smaller(run + LARGE, end));
        long long *from = dealt, *to = other;
        for (int size = LARGE; size < end - begin; size *= 2) {
            for (int left = begin; left < end; left += 2 * size) {
                const int middle = smaller(left + size, end), right = smaller(left + 2 * size, end);
                int a = left, b = middle;
                for (int i = left; i < right; ++i) {
                    const bool first = b >= right || (a < middle && from[a] < from[b]);
                    to[i] = first ? from[a++] : from[b++];
                }
            }
            long long* swap = from;
            from = to, to = swap;
        }
        if (from != dealt)
            for (int i = begin; i < end; ++i) dealt[i] = from[i];
    }
};
