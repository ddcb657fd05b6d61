"""Write files aside, then rename them, so that nobody reads half a file. For all parts of the package."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

log = logging.getLogger(__name__)

BENCH_SETTINGS = "settings.json"  # first file of a bench, which has a folder of its own
OUT_OF_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
LEFTOVER = re.compile(r"\..+\.\d+(\.tmp)?")


class WriteError(OSError):
    """A file cannot be written, because the disk is full, read-only, or out of reach. The message is one sentence."""


def printable(name: str) -> str:
    """Return a name as text that can be printed. Bytes that are not UTF-8 become hexadecimal escapes."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


@contextlib.contextmanager
def write_aside(path: str | Path, size: int | None = None) -> Iterator[Path]:
    """Yield a temporary path next to `path`. It is renamed to `path` on success and removed on failure.

    A link stays, and the file that it names is written.

    Args:
        path: The file to write.
        size: Approximate size in bytes, if it is known beforehand.

    Raises:
        WriteError: The file cannot be written. The message says why, and how much space it needs.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file() and not target.is_dir():
        raise WriteError(f"{path} is a device or a pipe, which a file would replace; give the name of a file.")
    temporary = target.parent / f".{target.name}.{os.getpid()}.tmp"
    try:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            yield temporary
            os.replace(temporary, target)
        finally:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
    except (OSError, RuntimeError) as error:
        cause = os_error(error)
        if cause is None or type(error).__module__.startswith("skipgs_plug."):  # the error has a sentence of its own
            raise
        raise write_error(path, cause, size) from error


def os_error(error: BaseException) -> OSError | None:
    """Return the OSError in an error's chain of causes, or None. Torch's writer raises RuntimeError on top of it."""
    found: BaseException | None = error
    while found is not None and not isinstance(found, OSError):
        found = found.__cause__ or found.__context__
    return found


@contextlib.contextmanager
def keep_going(failed: list[WriteError]) -> Iterator[None]:
    """Continue after a file that cannot be written: the error is logged and added to `failed`."""
    try:
        yield
    except OSError as error:
        sentence = error if isinstance(error, WriteError) else write_error(Path(error.filename or "A file"), error)
        log.warning("%s", sentence)
        failed.append(sentence)


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files of killed processes from a folder. No other process may be writing there."""
    for path in folder.glob(".*"):
        if LEFTOVER.fullmatch(path.name) and path.is_file():
            path.unlink(missing_ok=True)


def write_error(path: Path, error: OSError, size: int | None = None) -> WriteError:
    """Return the error to raise when `path`, of `size` bytes, cannot be written."""
    reason = os.strerror(error.errno) if error.errno else str(error)
    blocking = next((parent for parent in path.parents if os.path.isfile(parent)), None)
    if blocking is not None:
        return WriteError(
            f"{path} cannot be written ({reason}): {blocking} is a file, not a folder; give another path."
        )
    free = _free(path)
    # numpy's error tells how many items were written, but not why it stopped.
    if error.errno not in OUT_OF_SPACE and not (error.errno is None and free is not None and free < (size or 2**20)):
        if os.path.isdir(path):
            return WriteError(f"{path} cannot be written ({reason}): {path} is a folder; give the name of a file.")
        return WriteError(f"{path} cannot be written ({reason}); make its folder writable or give another one.")
    needed = "more room than there is" if size is None else f"about {_megabytes(size)}"
    left = "" if free is None else f", {_megabytes(free)} are free"
    return WriteError(f"{path} cannot be written ({reason}): it needs {needed}{left}; make room or give another one.")


def _free(path: Path) -> int | None:
    try:
        return shutil.disk_usage(path.parent).free
    except OSError:
        return None


def _megabytes(size: int) -> str:
    return f"{size / 1e6:,.1f} MB"
