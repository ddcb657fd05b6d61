"""Compiles, checks and runs kernels: launches, threads, the cache on disk, guard zones and memory."""
