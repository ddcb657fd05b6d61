"""Protects Warp's cache of compiled kernels against damaged files and folders that cannot be written.

Warp loads any object file that it finds, and damaged native code may do anything. A checksum beside each object file
detects damage. A file whose checksum differs, or that does not load, is deleted and compiled again.
"""

import hashlib
import os
import shutil
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from skipgs_plug.files import WriteError

_SUM = "sha256"


_choosing = threading.Lock()
_temporary: list[TemporaryDirectory[str]] = []  # folders of this process, removed when it ends


def in_temporary_folder(wp: Any, error: OSError) -> None:
    """Let Warp keep kernels in a temporary folder, because its cache cannot be written; warn once.

    Args:
        wp: The module `warp`.
        error: The failure to write.

    Raises:
        WriteError: There is no temporary folder that can be written. The message names the file and the fix.
    """
    with _choosing:
        if _temporary:
            return
        try:
            # Nobody else can put native code into it, unlike a folder whose name is known.
            _temporary.append(TemporaryDirectory(prefix="skipgs-plug-kernels-", ignore_cleanup_errors=True))
        except OSError as second:
            raise WriteError(_sentence(error, "there is no temporary folder")) from second
        wp.config.kernel_cache_dir = _temporary[0].name
    warnings.warn(_sentence(error, "each process compiles them again"), RuntimeWarning, stacklevel=3)


def _sentence(error: OSError, then: str) -> str:
    why = os.strerror(error.errno) if error.errno else str(error)
    return (
        f"The CPU rasterizer cannot keep its compiled kernels in {error.filename or 'Warp'} ({why}), and {then}: "
        "set WARP_CACHE_PATH to a folder that can be written."
    )


def load_or_rebuild(folder: Path, load: Callable[[], Any], forget: Callable[[], None]) -> Any:
    """Load a kernel from `folder`, or compile it again if it is missing or damaged.

    Args:
        folder: Folder where Warp keeps the object file of this source.
        load: Compiles the kernel if the folder is empty, loads it, and returns it.
        forget: Makes Warp forget the kernel, so that it reads the folder again.

    Returns:
        The kernel that `load` returned.

    Raises:
        OSError: The kernel has to be compiled, but the folder cannot be written.
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
    """Write a file atomically. A failure is ignored: the cache also works without checksums."""
    aside = path.with_name(f"{path.name}.{threading.get_ident()}.{os.getpid()}")
    try:
        aside.write_text(text)
        aside.replace(path)
    except OSError:
        aside.unlink(missing_ok=True)
