"""Attach a gate in each process that a script spawns, usually one per GPU."""

from __future__ import annotations

import pickle
import runpy
import sys
import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.reduction import ForkingPickler
from typing import Any

import torch

from skipgs_plug.adapters.base import GATES_SPAWNED
from skipgs_plug.scripts.launch import Attach, run_in_script

Enter = Callable[[int, bytes], None]


@contextmanager
def gated_when_spawned(enter: Enter) -> Iterator[list[int]]:
    """Let `torch.multiprocessing.spawn` start each process with `enter(rank, call)`, which must call `run_call`.

    A new process imports its parent's main module first. Here that module is empty, so `enter` runs first. It can
    install stand-ins and wrappers before the script is imported.

    Args:
        enter: A function of a module that a new process can import. It is pickled with its arguments.

    Yields:
        A list that gets one entry per spawn.
    """
    spawn = torch.multiprocessing.spawn
    spawned: list[int] = []

    def spawn_gated(fn: Callable[..., Any], args: tuple[Any, ...] = (), *more: Any, **options: Any) -> Any:
        call = bytes(ForkingPickler.dumps((fn, args)))  # pickled while the script is still the main module
        spawned.append(1)
        main = sys.modules["__main__"]
        sys.modules["__main__"] = types.ModuleType("__main__")
        try:
            return spawn(enter, (call,), *more, **options)
        finally:
            sys.modules["__main__"] = main

    setattr(spawn_gated, GATES_SPAWNED, True)
    torch.multiprocessing.spawn = spawn_gated
    try:
        yield spawned
    finally:
        torch.multiprocessing.spawn = spawn


def run_call(command: Sequence[str], attach: Attach, rank: int, call: bytes, on_cpu: bool) -> int:
    """Import the script in a spawned process, as Python would, and call the function that the script spawned.

    Args:
        command: See `run_script`.
        attach: See `run_script`.
        rank: Number of the process, from 0.
        call: The pickled call that `gated_when_spawned` passed to `enter`.
        on_cpu: See `run_script`.

    Returns:
        The exit code.
    """

    def run(script: str, names: dict[str, Any]) -> None:
        main = types.ModuleType("__mp_main__")
        sys.modules["__main__"] = sys.modules["__mp_main__"] = main
        vars(main).update(runpy.run_path(script, init_globals=names, run_name="__mp_main__"))
        fn, args = pickle.loads(call)
        fn(rank, *args)

    return run_in_script(command, attach, run, on_cpu)
