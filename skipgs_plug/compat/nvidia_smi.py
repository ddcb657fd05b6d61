"""A stand-in for the command `nvidia-smi`, which some scripts run to find the GPU with the most free memory."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def one_free_gpu() -> Iterator[None]:
    """Put an `nvidia-smi` on the path that reports one unused GPU, unless the machine has one."""
    if shutil.which("nvidia-smi") is not None:
        yield
        return
    before = os.environ.get("PATH", "")
    with tempfile.TemporaryDirectory(prefix="skipgs-") as folder:
        command = Path(folder, "nvidia-smi")
        command.write_text("#!/bin/sh\necho 'GPU 0'\necho '    Used : 0 MiB'\n")
        command.chmod(0o755)
        os.environ["PATH"] = f"{folder}{os.pathsep}{before}"
        try:
            yield
        finally:
            os.environ["PATH"] = before
