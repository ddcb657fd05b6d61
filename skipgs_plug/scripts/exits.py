"""Do something before a script ends its process at once, or puts another program in its place."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from skipgs_plug.compat.stand_ins import stand_ins


@contextmanager
def before_process_ends(exits: Callable[[], None], replaced: Callable[[str], None]) -> Iterator[None]:
    """Let `os._exit` and the functions `os.exec...` make a call first, inside the `with` statement.

    They end the process without `finally` blocks. Forked children end by them too.

    Args:
        exits: Called before `os._exit` ends a process.
        replaced: Called before another program takes the place of a process, with the path of the program. The process
            goes on if it raises an error.
    """
    end = os._exit

    def called_and_ended(status: int) -> None:
        try:
            exits()
        finally:
            end(status)

    def in_place(execute: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(execute)
        def called_and_replaced(path: Any, *args: Any, **kwargs: Any) -> Any:
            if _is_program(path):  # `os.execvp` tries all folders of PATH
                replaced(str(path))
            return execute(path, *args, **kwargs)

        return called_and_replaced

    # The other functions `os.exec...` call one of these two.
    with stand_ins(
        [(os, "_exit", called_and_ended), (os, "execv", in_place(os.execv)), (os, "execve", in_place(os.execve))]
    ):
        yield


def _is_program(path: Any) -> bool:
    return isinstance(path, int) or (os.path.isfile(path) and os.access(path, os.X_OK))
