"""Let the processes that a script spawns have the script's replacements before they import the script.

A process of the start methods `spawn` and `forkserver` begins as a new Python. It imports its parent's main module
under the name `__mp_main__`, and then unpickles its work. A forked process has its parent's replacements already.
"""

from __future__ import annotations

import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from multiprocessing import spawn
from typing import Any

Enter = Callable[[], AbstractContextManager[None]]

_entered_here: list[Enter] = []  # context managers, in the order in which new processes enter them
_until_exit = ExitStack()  # context managers that a child process entered; never closed
_MAIN = ("init_main_from_name", "init_main_from_path")  # keys of the data that name the main module
_preparation_data = spawn.get_preparation_data


@contextmanager
def also_in_children(enter: Enter) -> Iterator[None]:
    """Let each process that is spawned inside the `with` statement enter `enter()` too, and never leave it.

    Args:
        enter: A function that can be pickled. A process calls it before it imports its parent's main module.
    """
    before = spawn.get_preparation_data
    spawn.get_preparation_data = _with_child_main
    _entered_here.append(enter)
    try:
        yield
    finally:
        _entered_here.pop()
        spawn.get_preparation_data = before


def _with_child_main(name: str) -> dict[str, Any]:
    """Return the data with which multiprocessing prepares a new process, with `child_main` as the main module."""
    data = _preparation_data(name)
    main = {key: data.pop(key) for key in _MAIN if key in data}
    if main:
        data["init_main_from_name"] = f"{__package__}.child_main"
        # Pickled by itself: the new process unpickles `data` before it has its sys.path, on which our modules lie.
        data["sys_argv"] = [*data["sys_argv"], pickle.dumps((_entered_here, main)).hex()]
    return data


def import_main() -> dict[str, Any]:
    """Enter the parent's replacements, import its main module as multiprocessing does, and return its globals."""
    entered, main = pickle.loads(bytes.fromhex(sys.argv.pop()))
    for enter in entered:
        _until_exit.enter_context(enter())
    spawn.prepare(main)
    return vars(sys.modules["__mp_main__"])
