"""Processes that a script spawns itself, one for each device: the launcher's work is done again in each of them."""

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
    """Let `torch.multiprocessing.spawn` begin each process with `enter(rank, call)`, which ends in `run_call`.

    A new process imports the main module of its parent before anything else. Here it imports none, so that `enter`
    comes first, and can put stand-ins and wrappers in place before the script is imported.

    Args:
        enter: Of a module that a new process can import; pickled, as its arguments are.

    Yields:
        How often processes were spawned is the length of this list, later.
    """
    spawn = torch.multiprocessing.spawn
    spawned: list[int] = []

    def spawn_gated(fn: Callable[..., Any], args: tuple[Any, ...] = (), *more: Any, **options: Any) -> Any:
        call = bytes(ForkingPickler.dumps((fn, args)))  # while the script is the main module
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


def run_call(command: Sequence[str], attach: Attach, rank: int, call: bytes, on_cpu: bool = False) -> int:
    """In a spawned process: import the script as Python would there, and call what the script had spawned.

    Args:
        command: As for `run_script`.
        attach: As for `run_script`.
        rank: Number of the process.
        call: What `gated_when_spawned` gave to `enter`.
        on_cpu: As for `run_script`.
    """

    def run(script: str, names: dict[str, Any]) -> None:
        main = types.ModuleType("__mp_main__")
        sys.modules["__main__"] = sys.modules["__mp_main__"] = main
        vars(main).update(runpy.run_path(script, init_globals=names, run_name="__mp_main__"))
        fn, args = pickle.loads(call)
        fn(rank, *args)

    return run_in_script(command, attach, run, on_cpu)
