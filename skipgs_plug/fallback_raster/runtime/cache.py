"""Warp's cache of compiled kernels, when it is damaged or cannot be written.

Warp loads whatever object file it finds, and code with a few wrong bytes is native code that does anything. A checksum
beside each object file tells; what does not fit or does not load is thrown away and compiled again.
"""

import hashlib
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from skipgs_plug.files import WriteError

_SUM = "sha256"


@contextmanager
def say_unwritable() -> Iterator[None]:
    """Turns the failure to write a kernel inside the block into a sentence.

    Raises:
        WriteError: Names the file and the way out.
    """
    try:
        yield
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error)
        raise WriteError(
            f"The CPU rasterizer cannot keep its compiled kernels in {error.filename or 'Warp'}: {why}; "
            "set WARP_CACHE_PATH to a folder that can be written."
        ) from error


def load_or_rebuild(folder: Path, load: Callable[[], Any], forget: Callable[[], None]) -> Any:
    """Loads a kernel, from `folder` where Warp has compiled it before.

    Args:
        folder: Where Warp keeps what it compiles from this source.
        load: Compiles if there is nothing in the folder, loads, and returns the loaded kernel.
        forget: Makes Warp look into the folder again.

    Returns:
        What `load` returns.

    Raises:
        WriteError: It has to be compiled, and the folder cannot be written.
    """
    if any(_checksum(path) != _expected(path) for path in folder.glob("*.o") if _expected(path) is not None):
        shutil.rmtree(folder, ignore_errors=True)
    existed = folder.exists()
    try:
        loaded = load()
    except Exception:
        if not existed:
            raise
        shutil.rmtree(folder, ignore_errors=True)
        forget()
        loaded = load()
    for path in folder.glob("*.o"):
        if _expected(path) is None:
            _write(path.with_suffix(f".{_SUM}"), _checksum(path))
    return loaded


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _expected(path: Path) -> str | None:
    try:
        return path.with_suffix(f".{_SUM}").read_text(errors="replace")
    except OSError:
        return None


def _write(path: Path, text: str) -> None:
    """A cache that cannot be written works without checksums."""
    aside = path.with_name(f"{path.name}.{threading.get_ident()}.{os.getpid()}")
    try:
        aside.write_text(text)
        aside.replace(path)
    except OSError:
        aside.unlink(missing_ok=True)
