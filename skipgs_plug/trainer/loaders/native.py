"""The one place that loads pycolmap: after Pillow, and without its handler of SIGTERM.

On Linux pycolmap brings a zlib whose functions Pillow's own are then bound to, some of them: after `import pycolmap`
the first PNG that Pillow writes ends the process (deflateEnd frees what another deflateInit allocated). With Pillow
loaded first, both work.

Its logging library answers SIGTERM with a stack trace of the process; what Python had in place comes back, and a signal
that arrives while it is loaded waits for that.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Iterator
from typing import Any

import PIL.Image  # noqa: F401

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError

# sys.modules keeps the order in which modules were loaded.
if sys.platform == "linux" and next(m for m in sys.modules if m in ("pycolmap", "PIL._imaging")) == "pycolmap":
    raise ImportError("pycolmap was imported before Pillow, which crashes Python later: import PIL.Image before it.")


def import_pycolmap() -> Any:
    """Return the module, which is loaded on first use.

    Raises:
        InputError: pycolmap is not installed.
    """
    try:
        with contextlib.nullcontext() if "pycolmap" in sys.modules else _sigterm_kept():
            import pycolmap
    except ImportError as error:
        raise InputError(f"Cameras of photographs need pycolmap ({error}); run: {install_command()}.") from error
    return pycolmap


@contextlib.contextmanager
def _sigterm_kept() -> Iterator[None]:
    """Put back at the end what answers SIGTERM, and let the signal wait until then."""
    before = signal.getsignal(signal.SIGTERM)  # None: not from Python, and not ours to put back
    can_wait = hasattr(signal, "pthread_sigmask")
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM}) if can_wait else set()
    try:
        yield
    finally:
        if before is not None:
            with contextlib.suppress(ValueError):  # another thread than the main one may not
                signal.signal(signal.SIGTERM, before)
        if can_wait:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
