"""Allow one process per run folder, since two processes would mix their files."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from skipgs_plug.files import write_error
from skipgs_plug.trainer.errors import InputError
from skipgs_plug.trainer.files import write_json

log = logging.getLogger(__name__)

LOCK = ".lock"  # the operating system frees the lock however its process ends, so it is never stale
OWNER = ".owner.json"  # host and process id of the holder


@contextlib.contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Create a folder, and hold it for this process alone inside the block.

    Raises:
        InputError: Another process holds it. The message names its host and process id.
        WriteError: The folder cannot be written.
    """
    from filelock import FileLock, Timeout

    lock = FileLock(folder / LOCK, timeout=0)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except Timeout as error:
        raise InputError(
            f"{folder} is in use by {_owner(folder)}; wait for it, end it, or give another --out."
        ) from error
    except NotImplementedError:
        log.warning("The file system of %s has no locks: make sure that no other process writes there.", folder)
    except OSError as error:
        raise write_error(folder / LOCK, error) from error
    try:
        write_json(folder / OWNER, {"host": socket.gethostname(), "pid": os.getpid()})
        yield
    finally:
        with contextlib.suppress(OSError):
            (folder / OWNER).unlink(missing_ok=True)
        lock.release()


def _owner(folder: Path) -> str:
    try:
        owner = json.loads((folder / OWNER).read_text())
        return f"process {int(owner['pid'])} on {str(owner['host'])[:200]}"
    except (OSError, ValueError, KeyError, TypeError):  # the other process has not written its name yet
        return "another process"
