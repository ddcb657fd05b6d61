// One launch: on the caller's thread, and on those of helpers that come before it is done here. Without a function the
// helpers are dismissed.
//
// Writes the launch into `pool`, alone, and the state, as all threads do.
#pragma once
#include "lib/thread_pool.h"
static constexpr auto pool_run = [](ThreadPool& pool, void (*function)(void*, void*), void* bounds, void* arguments,
                                    int helpers, int patience) INLINE {
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
    __atomic_store_n(&pool.state, launch << 32 | OPEN, __ATOMIC_SEQ_CST);
    wake();
    pool.function(pool.bounds, pool.arguments);
    // Who has not come by now would find nothing left.
    const int joined = (int)(__atomic_fetch_and(&pool.state, ~OPEN, __ATOMIC_SEQ_CST) & (OPEN - 1));
    const auto done = [&]() { return __atomic_load_n(&pool.finished, __ATOMIC_SEQ_CST) == joined; };
    for (int spins = 0; spins < patience && !done(); ++spins) PAUSE();
    while (!done()) {
        __atomic_store_n(&pool.caller_sleeps, 1, __ATOMIC_SEQ_CST);
        // The last helper may have looked before: then nobody calls, unless it sees the mark after all.
        if (!done() || !__atomic_exchange_n(&pool.caller_sleeps, 0, __ATOMIC_SEQ_CST))
            pool.caller.acquire(pool.caller.lock, 1);
    }
};
