"""Loading pycolmap changes neither the reading of PNG files nor the handling of SIGTERM."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest


def test_png_after_pycolmap(tmp_path) -> None:
    code = (
        "from skipgs_plug.trainer.loaders.native import import_pycolmap\n"
        "import_pycolmap()\n"
        "from PIL import Image\n"
        f"Image.new('RGB', (64, 64), 'red').save({str(tmp_path / 'x.png')!r})\n"
        f"Image.open({str(tmp_path / 'x.png')!r}).load()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_order_that_crashes_is_refused_at_import() -> None:
    code = "import pycolmap\nfrom skipgs_plug.trainer import load_scene\n"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if sys.platform == "linux":
        assert "ImportError: pycolmap was imported before Pillow" in done.stderr and done.returncode == 1
    else:
        assert done.returncode == 0, done.stderr


@pytest.mark.skipif(os.name != "posix", reason="SIGTERM ends no process elsewhere")
def test_sigterm_stays_what_it_was() -> None:
    code = (
        "import os, signal\n"
        "from skipgs_plug.trainer.loaders.native import import_pycolmap\n"
        "{handler}import_pycolmap()\n"
        "os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    for handler, returned in (("", -signal.SIGTERM), ("signal.signal(signal.SIGTERM, lambda *_: print('mine'))\n", 0)):
        command = [sys.executable, "-c", code.format(handler=handler)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, done.stderr, done.stdout) == (returned, "", "mine\n" if handler else "")
