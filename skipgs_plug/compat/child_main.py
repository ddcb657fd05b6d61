"""The main module of a spawned process, in place of the script; see `child_processes`."""

from .child_processes import import_main

if __name__ == "__mp_main__":
    globals().update(import_main())
