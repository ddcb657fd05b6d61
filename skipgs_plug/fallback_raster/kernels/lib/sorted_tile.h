// The list of one tile, sorted front to back as far as somebody asks: behind what fills its pixels nobody does.
//
// Pairs are dealt into buckets of equal ranges of the depth's bits, and buckets are sorted when their turn comes. Equal
// depths keep the order of the rows, which is that of the numbers in the lower half.
#pragma once
#include "simd.h"

// Pairs in a bucket above which it is dealt again: sorting a bucket takes as many rounds as it has pairs.
#ifdef __AVX2__
static constexpr int LARGE = 16;
#else
static constexpr int LARGE = 8;  // registers hold two pairs, so that rounds take longer
#endif
struct SortedTile {
    long long *dealt, *other;  // the tile's pairs in buckets, and as much room again
    int *record, *pair;        // out: record and number of each pair
    const int* pair_record;
    int count, done, next, shift;  // pairs, those that are sorted, the next bucket, and bits of depth in one
    int bound[BUCKETS + 2];        // where each bucket begins, and the last one ends

    SortedTile(int begin, int end, const TileLists& lists)
        : dealt(lists.buffer + begin), other(lists.unsorted + begin), record(lists.tile_record + begin),
          pair(lists.tile_pair + begin), pair_record(lists.pair_record), count(end - begin), done(0), next(0) {
        // Twice as many buckets as pairs: most of them hold one or none.
        int buckets = 64;
        while (buckets < 2 * count && buckets < BUCKETS) buckets *= 2;
        bound[0] = 0;
        shift = deal(other, dealt, count, bound + 1, buckets);
    }

    // Sorts at least the first `wanted` pairs, or all.
    void sort(int wanted) {
        wanted = smaller(wanted, count);
        if (done >= wanted) return;
        int longest = 0;
        while (bound[next] < wanted) {  // 16 buckets at a time, which their number is a multiple of
            const int most = __builtin_reduce_max(*(const i16*)(bound + next + 1) - *(const i16*)(bound + next));
            if (most > LARGE && shift > 0)
                for (int b = next; b < next + 16; ++b)
                    if (bound[b + 1] - bound[b] > LARGE) refine(bound[b], bound[b + 1]);
            longest = larger(longest, most);
            next += 16;
        }
        const int end = bound[next];
        // A full bucket that was not dealt again holds one depth, in order.
        settle(done, end, smaller(longest, LARGE));
        for (int i = done; i < end; ++i) pair[i] = (int)dealt[i];
        for (int i = done; i < end; ++i) record[i] = pair_record[pair[i]];
        done = end;
    }

  private:
    // Sorts where no pair is farther from its place than a bucket of `longest` pairs allows: neighbours trade places, each
    // pair with the next and then with the one before (odd-even transposition, Habermann 1972). Which of them do nobody
    // can foresee, so that comparing all costs less than a branch for each.
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

    // Moves pairs into buckets of equal ranges; `bucket` [buckets + 1] gets the end of each, the result is the width of
    // the ranges in bits.
    static int deal(const long long* from, long long* to, int count, int* bucket, int buckets) {
        int least = 0x7fffffff, most = 0, shift = 0;
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

    // Deals a full bucket again, over its own range: eight bits less each time, so four times at most.
    void refine(int begin, int end) {
        int bucket[257];
        const int buckets = end - begin > 32 ? 256 : 64;
        const int width = deal(dealt + begin, other + begin, end - begin, bucket, buckets);
        for (int i = begin; i < end; ++i) dealt[i] = other[i];
        if (width > 0)
            for (int b = 0, from = begin; b < buckets; from = begin + bucket[b++])
                if (begin + bucket[b] - from > LARGE) refine(from, begin + bucket[b]);
    }
};
