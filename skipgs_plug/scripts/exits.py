"""Do something before a script ends its process at once."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from skipgs_plug.compat.stand_ins import stand_ins


@contextmanager
def before_os_exit(call: Callable[[], None]) -> Iterator[None]:
    """Let `os._exit` make a call first, inside the `with` statement.

    It ends the process without `finally` blocks. Forked children end by it too; they do not make the call.
    """
    process, end = os.getpid(), os._exit

    def called_and_ended(status: int) -> None:
        try:
            if os.getpid() == process:
                call()
        finally:
            end(status)

    with stand_ins([(os, "_exit", called_and_ended)]):
        yield
