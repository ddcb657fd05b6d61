"""Standard streams that end no command: closed ones, characters that the locale lacks, a full disk, a lost terminal."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from typing import Any

# A full disk, and a terminal that was closed while the command runs on.
LOSSES = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)


class LossyFile(io.FileIO):
    """An open file that drops what cannot be written: a log on a full disk costs its text, not the run.

    A reader who is gone raises BrokenPipeError as before, since nobody waits for the rest.

    Attributes:
        lost: Why text was dropped; None if all was written.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number, "w", closefd=False)
        self.lost: str | None = None

    def write(self, data: Any, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            if error.errno not in LOSSES:
                raise
            self.lost = error.strerror
            return memoryview(data).nbytes


def replace_closed_streams() -> None:
    """Replace standard streams that were closed (`>&-`, some schedulers) by the null device.

    Otherwise the next opened file would get the number of a closed stream, and output of a library would land in it.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115 - open until the process ends


def print_any_name() -> None:
    """Print characters that the locale lacks as escapes, instead of raising an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def drop_what_does_not_fit() -> list[LossyFile]:
    """Let stdout and stderr of the process drop what cannot be written, and return the files that count it."""
    files = []
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        buffer = getattr(stream, "buffer", None)
        if not isinstance(getattr(buffer, "raw", buffer), io.FileIO):  # a console of Windows writes differently
            continue
        file = LossyFile(stream.fileno())
        layout = {option: getattr(stream, option) for option in ("encoding", "errors", "line_buffering")}
        through = stream.write_through  # python -u
        written = io.TextIOWrapper(
            file if through else io.BufferedWriter(file),  # type: ignore[arg-type]
            write_through=through,
            **layout,
        )
        setattr(sys, name, written)
        files.append(file)
    return files


def flush() -> None:
    """Write what is still in memory, while an error of it can be answered."""
    sys.stdout.flush()
    with contextlib.suppress(OSError):
        sys.stderr.flush()
