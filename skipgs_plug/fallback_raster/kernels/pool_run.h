// Runs one launch on the caller's thread and on every helper that joins before the caller has finished. A null function
// dismisses the helpers.
//
// Writes the launch into `pool`; no other thread does. All threads update `pool.state`.
#pragma once
#include "lib/thread_pool.h"
static constexpr auto pool_run = [](ThreadPool& pool, void (*function)(void*, void*), void* bounds, void* arguments,
                                    int helpers, int max_spins) INLINE {
    const auto wake = [&]() {
        for (int i = 0; i < helpers; ++i)
            if (__atomic_exchange_n(&pool.helpers[i].sleeps, 0, __ATOMIC_SEQ_CST))
                pool.helpers[i].lock.release(pool.helpers[i].lock.lock);
    };
    if (!function) {
        __atomic_store_n(&pool.stop, 1, __ATOMIC_SEQ_CST);
        wake();
        return;
    }
    pool.function = function;
    pool.bounds = bounds;
    pool.arguments = arguments;
    pool.finished = 0;
    const unsigned long long launch = (unsigned)(pool.state >> 32) + 1;
    __atomic_store_n(&pool.state, launch << 32 | ACCEPTS_HELPERS, __ATOMIC_SEQ_CST);
    wake();
    pool.function(pool.bounds, pool.arguments);
    // Close the launch: a helper that has not joined yet would find no work left.
    const int joined = (int)(__atomic_fetch_and(&pool.state, ~ACCEPTS_HELPERS, __ATOMIC_SEQ_CST) & (ACCEPTS_HELPERS - 1));
    const auto done = [&]() { return __atomic_load_n(&pool.finished, __ATOMIC_SEQ_CST) == joined; };
    for (int spins = 0; spins < max_spins && !done(); ++spins) PAUSE();
    while (!done()) {
        __atomic_store_n(&pool.caller_sleeps, 1, __ATOMIC_SEQ_CST);
        // The last helper may have read the mark before it was set. Then it wakes nobody, and the caller must not
        // sleep.
        if (!done() || !__atomic_exchange_n(&pool.caller_sleeps, 0, __ATOMIC_SEQ_CST))
            pool.caller.acquire(pool.caller.lock, 1);
    }
};
