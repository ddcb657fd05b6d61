// Memory that the calling thread and its helpers share. Each cache line has one writer, except for the line of `state`,
// which all threads update, and the line of `finished`.
#pragma once
#include "simd.h"
#if defined(__x86_64__) || defined(__i386__)
#define PAUSE() __builtin_ia32_pause()
#elif defined(__aarch64__)
#define PAUSE() __builtin_arm_yield()  // Warp's Clang has no assembler for this processor
#else
#define PAUSE()
#endif

// Bit 31 of `state`: helpers may join. The bits below count the helpers that joined, the 32 bits above number the
// launch.
static constexpr unsigned long long ACCEPTS_HELPERS = 1u << 31;

struct Lock {  // a lock of CPython and its functions, which work without the interpreter lock
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
