"""Whatever compiles, checks and runs kernels: launch, threads, cache, guard zones, memory."""
