// One launch: on the caller's thread, and on those of helpers that come before it is done here. Without a function the
// helpers are dismissed.
#include "crew.h"
Crew& crew = *(Crew*)crew_address;
const auto wake = [&]() {
    for (int i = 0; i < helpers; ++i)
        if (__atomic_exchange_n(&crew.helpers[i].sleeps, 0, __ATOMIC_SEQ_CST))
            crew.helpers[i].lock.release(crew.helpers[i].lock.lock);
};
if (!function_address) {
    __atomic_store_n(&crew.stop, 1, __ATOMIC_SEQ_CST);
    wake();
    return;
}
crew.function = (void (*)(void*, void*))function_address;
crew.bounds = (void*)bounds_address;
crew.block = (void*)block_address;
crew.finished = 0;
const unsigned long long launch = (unsigned)(crew.state >> 32) + 1;
__atomic_store_n(&crew.state, launch << 32 | OPEN, __ATOMIC_SEQ_CST);
wake();
crew.function(crew.bounds, crew.block);
// Who has not come by now would find nothing left.
const int joined = (int)(__atomic_fetch_and(&crew.state, ~OPEN, __ATOMIC_SEQ_CST) & (OPEN - 1));
const auto done = [&]() { return __atomic_load_n(&crew.finished, __ATOMIC_SEQ_CST) == joined; };
for (int spins = 0; spins < patience && !done(); ++spins) PAUSE();
while (!done()) {
    __atomic_store_n(&crew.caller_sleeps, 1, __ATOMIC_SEQ_CST);
    // The last helper may have looked before: then nobody calls, unless it sees the mark after all.
    if (!done() || !__atomic_exchange_n(&crew.caller_sleeps, 0, __ATOMIC_SEQ_CST))
        crew.caller.acquire(crew.caller.lock, 1);
}
