"""The one place that loads pycolmap: after Pillow, and without its handler of SIGTERM.

On Linux pycolmap brings its own zlib, and Pillow is then bound to some of its functions: after `import pycolmap`, the
first PNG that Pillow writes ends the process (deflateEnd frees memory of another deflateInit). When Pillow is loaded
first, both work.

pycolmap's logging library answers SIGTERM with a stack trace of the process; Python's handler is put back.
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
    """Return the module, which is loaded on first use.

    Raises:
        InputError: pycolmap is not installed.
    """
    loaded = "pycolmap" in sys.modules
    before = signal.getsignal(signal.SIGTERM)  # None: not from Python, and not ours to put back
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(f"Cameras of photographs need pycolmap ({error}); run: {install_command()}.") from error
    if not loaded and before is not None:
        with contextlib.suppress(ValueError):  # another thread than the main one may not
            signal.signal(signal.SIGTERM, before)
    return pycolmap
