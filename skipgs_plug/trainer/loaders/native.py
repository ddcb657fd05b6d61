"""The one place that loads pycolmap: after Pillow, and without its handler of SIGTERM.

On Linux, pycolmap brings its own zlib, and a Pillow that is imported later is bound to some of its functions. Then the
first PNG that Pillow writes ends the process (deflateEnd frees memory of another deflateInit). If Pillow is imported
first, both work.

pycolmap's logging library replaces the handler of SIGTERM and prints a stack trace. This module restores Python's
handler.
"""

from __future__ import annotations

import contextlib
import signal
import sys
from typing import Any

import PIL.Image  # noqa: F401

from skipgs_plug.install import install_command
from skipgs_plug.trainer.errors import InputError

# sys.modules keeps the order in which modules were loaded.
if sys.platform == "linux" and next(m for m in sys.modules if m in ("pycolmap", "PIL._imaging")) == "pycolmap":
    raise ImportError("pycolmap was imported before Pillow, which crashes Python later: import PIL.Image before it.")


def import_pycolmap() -> Any:
    """Import pycolmap and return it.

    Raises:
        InputError: pycolmap is not installed.
    """
    loaded = "pycolmap" in sys.modules
    before = signal.getsignal(signal.SIGTERM)  # None: the handler is not from Python and cannot be restored
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(f"Cameras of photographs need pycolmap ({error}); run: {install_command()}.") from error
    if not loaded and before is not None:
        with contextlib.suppress(ValueError):  # only the main thread may set a handler
            signal.signal(signal.SIGTERM, before)
    return pycolmap
