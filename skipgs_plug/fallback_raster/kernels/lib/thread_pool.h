// What the thread that calls kernels and its helpers share. No line of memory is written to by both at a time, but for
// `state`, on which they agree.
#pragma once
#include "simd.h"
#if defined(__x86_64__) || defined(__i386__)
#define PAUSE() __builtin_ia32_pause()
#elif defined(__aarch64__)
#define PAUSE() __builtin_arm_yield()  // the compiler inside Warp has no assembler for this processor
#else
#define PAUSE()
#endif

static constexpr unsigned long long OPEN = 1u << 31;  // of a state; below it the helpers that joined, above it the launch

struct Lock {  // of Python, and its functions, which need no interpreter lock
    void* lock;
    auto (*acquire)(void*, int) -> int;
    void (*release)(void*);
};

struct ThreadPool {
    alignas(64) unsigned long long state;
    alignas(64) void (*function)(void*, void*);
    void *bounds, *arguments;
    int stop;
    alignas(64) int finished;
    int caller_sleeps;
    Lock caller;
    struct Helper {
        alignas(64) int sleeps;
        Lock lock;
    } helpers[];
};
