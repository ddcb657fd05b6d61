// The loop of a helper: it waits for launches and joins them until it is dismissed.
//
// Reads the launch in `pool`. Writes its own cache line there, and adds to `finished`. All threads update `pool.state`.
#pragma once
#include "lib/thread_pool.h"
static constexpr auto pool_serve = [](ThreadPool& pool, int number, int max_spins) INLINE {
    ThreadPool::Helper& own = pool.helpers[number];
    unsigned last = 0;
    for (;;) {
        unsigned long long state;
        for (int spins = 0;; ++spins) {
            state = __atomic_load_n(&pool.state, __ATOMIC_SEQ_CST);
            if ((unsigned)(state >> 32) != last || __atomic_load_n(&pool.stop, __ATOMIC_SEQ_CST)) break;
            if (spins < max_spins) {
                PAUSE();
                continue;
            }
            // The caller writes `state` before it reads `sleeps`, the helper writes `sleeps` before it reads `state`:
            // at least one of them sees the other's write.
            __atomic_store_n(&own.sleeps, 1, __ATOMIC_SEQ_CST);
            const bool called = (unsigned)(__atomic_load_n(&pool.state, __ATOMIC_SEQ_CST) >> 32) != last
                             || __atomic_load_n(&pool.stop, __ATOMIC_SEQ_CST);
            if (!called || !__atomic_exchange_n(&own.sleeps, 0, __ATOMIC_SEQ_CST)) own.lock.acquire(own.lock.lock, 1);
            spins = 0;
        }
        if (__atomic_load_n(&pool.stop, __ATOMIC_SEQ_CST)) break;
        last = (unsigned)(state >> 32);
        while ((state & ACCEPTS_HELPERS) && (unsigned)(state >> 32) == last) {
            if (!__atomic_compare_exchange_n(&pool.state, &state, state + 1, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST))
                continue;
            pool.function(pool.bounds, pool.arguments);
            __atomic_fetch_add(&pool.finished, 1, __ATOMIC_SEQ_CST);
            if (__atomic_load_n(&pool.caller_sleeps, __ATOMIC_SEQ_CST)
                && __atomic_exchange_n(&pool.caller_sleeps, 0, __ATOMIC_SEQ_CST))
                pool.caller.release(pool.caller.lock);
            break;
        }
    }
};
