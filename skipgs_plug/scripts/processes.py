"""The processes of a script: which of them trains, and whether a gate reaches it."""

from __future__ import annotations

import functools
import itertools
import mmap
import os
import shlex
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skipgs_plug.compat.stand_ins import stand_ins
from skipgs_plug.core.elsewhere import TRAINED_AFTER
from skipgs_plug.core.intercept import Patches, intercept_tensor_backward
from skipgs_plug.messages import say

IN_ONE_PROCESS = "Train in the script's own process, or write skipgs-plug run before the command of that one."


class Beginning:
    """Where training began. A forked process has the gate of its parent, and may train instead of it."""

    def __init__(self) -> None:
        self._process: int | None = None
        self._anywhere = mmap.mmap(-1, 1)  # forked processes share it

    def note(self) -> None:
        """Training begins in this process."""
        self._process = os.getpid()
        self._anywhere[0] = 1

    @property
    def here(self) -> bool:
        """Whether training began in this process, and not in the one that it was forked from."""
        return self._process == os.getpid()

    @property
    def anywhere(self) -> bool:
        """Whether training began in this process, in one that it was forked from, or in one forked from it."""
        return self._anywhere[0] == 1


@contextmanager
def told_if_it_trains(script: str) -> Iterator[None]:
    """Warn of training inside the block. For a process that `script` has spawned, and that no gate reaches.

    Args:
        script: Name of the script.
    """
    count = itertools.count(1)

    def note(caller: str) -> None:
        if next(count) == TRAINED_AFTER:
            say(
                f"{caller}() called backward in a process that {script} has spawned, which no gate reaches. If this "
                f"is training, nothing is gated. {IN_ONE_PROCESS}"
            )

    patches = Patches()
    intercept_tensor_backward(patches, (), lambda loss, run, keeps_graph: run(), note)
    try:
        yield
    finally:
        patches.restore()


@contextmanager
def told_if_it_starts_itself(script: Path, matters: Callable[[], bool]) -> Iterator[None]:
    """Warn if a script starts itself as another program inside the block, such as once for each device.

    Args:
        script: File of the script.
        matters: Returns whether the gate is on and has not seen any training.
    """

    def told(start: Callable[..., Any], command_at: int) -> Callable[..., Any]:
        @functools.wraps(start)
        def told_and_started(*args: Any, **kwargs: Any) -> Any:
            command = args[command_at] if len(args) > command_at else kwargs.get("args", kwargs.get("command"))
            if matters() and any(_is_file(word, script) for word in _words(command)):
                say(
                    f"{script.name} starts itself in another process, which no gate reaches. If that process trains, "
                    f"nothing is gated. {IN_ONE_PROCESS}"
                )
            return start(*args, **kwargs)

        return told_and_started

    popen = (subprocess.Popen, "__init__", told(subprocess.Popen.__init__, 1))
    with stand_ins([popen, (os, "system", told(os.system, 0))]):
        yield


def _words(command: Any) -> list[str]:
    """Return the words of a command that is given as a list, a path or a text for a shell."""
    try:
        return shlex.split(command) if isinstance(command, str) else [os.fsdecode(word) for word in command]
    except (TypeError, ValueError):  # a path, or quotes that do not end
        return []


def _is_file(word: str, script: Path) -> bool:
    return os.path.basename(word) == script.name and os.path.exists(word) and os.path.samefile(word, script)
