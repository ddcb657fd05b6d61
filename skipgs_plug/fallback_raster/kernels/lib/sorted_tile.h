// The list of one tile, sorted front to back on demand: the pairs behind the one that fills the tile's pixels are never
// sorted.
//
// Pairs are distributed to buckets of equal ranges of the depth's bits, and 16 buckets are sorted at a time. Pairs of
// equal depth keep the order of the rows, which is the order of the numbers in their lower 32 bits.
#pragma once
#include "simd.h"

// Pairs in a bucket above which it is distributed again: sorting takes as many rounds as the fullest bucket has pairs.
#ifdef __AVX2__
static constexpr int MAX_BUCKET_PAIRS = 16;
#else
static constexpr int MAX_BUCKET_PAIRS = 8;  // a register holds only two pairs, so a round takes longer
#endif
struct SortedTile {
    long long *dealt, *other;  // pairs of the tile in buckets, and scratch of the same size
    int *record, *pair;        // outputs: record and number of each pair
    const int* pair_record;
    int count, done, next, shift;  // pairs; sorted pairs; next bucket; log2 of the range of a bucket
    int bound[MAX_BUCKETS + 2];    // start of each bucket, and end of the last one

    SortedTile(int begin, int end, const TileLists& lists)
        : dealt(lists.buffer + begin), other(lists.unsorted + begin), record(lists.tile_record + begin),
          pair(lists.tile_pair + begin), pair_record(lists.pair_record), count(end - begin), done(0), next(0) {
        // At least twice as many buckets as pairs: most buckets hold one pair or none.
        int buckets = 64;
        while (buckets < 2 * count && buckets < MAX_BUCKETS) buckets *= 2;
        bound[0] = 0;
        shift = deal(other, dealt, count, bound + 1, buckets);
    }

    // Sorts at least the first `wanted` pairs, or all if there are fewer.
    void sort(int wanted) {
        wanted = smaller(wanted, count);
        if (done >= wanted) return;
        int longest = 0;
        while (bound[next] < wanted) {  // 16 buckets at a time; their number is a multiple of 16
            const int most = __builtin_reduce_max(*(const i16*)(bound + next + 1) - *(const i16*)(bound + next));
            if (most > MAX_BUCKET_PAIRS && shift > 0)
                for (int b = next; b < next + 16; ++b)
                    if (bound[b + 1] - bound[b] > MAX_BUCKET_PAIRS) refine(bound[b], bound[b + 1]);
            longest = larger(longest, most);
            next += 16;
        }
        const int end = bound[next];
        // A bucket that is still too full after `refine` holds a single depth and is in order.
        settle(done, end, smaller(longest, MAX_BUCKET_PAIRS));
        for (int i = done; i < end; ++i) pair[i] = (int)dealt[i];
        for (int i = done; i < end; ++i) record[i] = pair_record[pair[i]];
        done = end;
    }

  private:
    // Sorts pairs that are at most `longest` positions from where they belong: neighbours trade places, first (0, 1),
    // (2, 3)..., then (1, 2), (3, 4)... (odd-even transposition sort, Habermann 1972). Whether two trade is
    // unpredictable: comparing all with vector minimum and maximum costs less than mispredicted branches.
    void settle(int begin, int end, int longest) {
        typedef long long l8 __attribute__((ext_vector_type(8), aligned(8)));
        for (int round = 0; round <= longest; ++round) {
            int i = begin + (round & 1);
            for (; i + 8 <= end; i += 8) {
                const l8 a = *(const l8*)(dealt + i), b = __builtin_shufflevector(a, a, 1, 0, 3, 2, 5, 4, 7, 6);
                const l8 low = __builtin_elementwise_min(a, b), high = __builtin_elementwise_max(a, b);
                *(l8*)(dealt + i) = __builtin_shufflevector(low, high, 0, 9, 2, 11, 4, 13, 6, 15);
            }
            for (; i + 2 <= end; i += 2) {
                const long long a = dealt[i], b = dealt[i + 1];
                dealt[i] = a < b ? a : b;
                dealt[i + 1] = a < b ? b : a;
            }
        }
    }

    // Distributes pairs to buckets of equal ranges of depth. `bucket` [buckets + 1] receives the end of each. Returns
    // log2 of the range.
    static int deal(const long long* from, long long* to, int count, int* bucket, int buckets) {
        int least = NO_DEPTH, most = 0, shift = 0;
        for (int i = 0; i < count; ++i) {
            const int key = (int)(from[i] >> 32);
            least = smaller(least, key), most = larger(most, key);
        }
        while ((most - least) >> shift >= buckets) ++shift;
        for (int b = 0; b <= buckets; ++b) bucket[b] = 0;
        for (int i = 0; i < count; ++i) ++bucket[((int)(from[i] >> 32) - least) >> shift];
        int sum = 0;
        for (int b = 0; b < buckets; b += 16) {
            const i16 pairs = *(const i16*)(bucket + b);
            i16 up_to = pairs;
            up_to += __builtin_shufflevector(up_to, (i16)0, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14);
            up_to += __builtin_shufflevector(up_to, (i16)0, 16, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13);
            up_to += __builtin_shufflevector(up_to, (i16)0, 16, 16, 16, 16, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11);
            up_to += __builtin_shufflevector(up_to, (i16)0, 16, 16, 16, 16, 16, 16, 16, 16, 0, 1, 2, 3, 4, 5, 6, 7);
            *(i16*)(bucket + b) = up_to - pairs + sum;
            sum += up_to[15];
        }
        bucket[buckets] = sum;
        for (int i = 0; i < count; ++i) to[bucket[((int)(from[i] >> 32) - least) >> shift]++] = from[i];
        return shift;
    }

    // Distributes a full bucket again over its own range. Each level resolves 6 or 8 more bits of depth.
    void refine(int begin, int end) {
        int bucket[257];
        const int buckets = end - begin > 32 ? 256 : 64;
        const int width = deal(dealt + begin, other + begin, end - begin, bucket, buckets);
        for (int i = begin; i < end; ++i) dealt[i] = other[i];
        if (width > 0)
            for (int b = 0, from = begin; b < buckets; from = begin + bucket[b++])
                if (begin + bucket[b] - from > MAX_BUCKET_PAIRS) refine(from, begin + bucket[b]);
    }
};
